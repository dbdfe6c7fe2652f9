"""The checks of combined scenes find every fault that they were written for, once it is back in the package."""

import pytest

from combinations.mutations import FAULTS, Fault, problems_with


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_fault_that_is_back_is_found(fault: Fault) -> None:
    """That the same scenes are without problems otherwise is a default test."""
    assert problems_with(fault)
