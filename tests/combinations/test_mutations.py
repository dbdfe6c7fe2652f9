"""The checks of combined scenes detect every fault for which they were written, once it is restored in the package."""

import pytest

from combinations.mutations import FAULTS, Fault, problems_with


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_fault_that_is_back_is_found(fault: Fault) -> None:
    """A default test checks that the same scenes have no problems otherwise."""
    assert problems_with(fault)
