"""What other rows leave of a row's mobility, and how much of that is rounding."""

import numpy as np
import pytest

from dynsim.integrators.contacts.resting import NEARLY_DEPENDENT, ROUNDINGS, extended, mobility_left, rounding_left

# One rounding of a number near 1.
ULP = 2.0**-52


def factored(W):
    """Factor of the rows of W before the last one, and their order."""
    factor, row, count = np.zeros(W.shape), np.zeros(len(W), dtype=int), 0
    for r in range(len(W) - 1):
        count = extended(factor, W, row, count, r)
    return factor, row, count


@pytest.mark.parametrize("angle", [3e-3, 1e-3, 3e-4])
@pytest.mark.parametrize("ulps", range(-2, 3))
def test_row_that_depends_on_two_that_nearly_do_is_dependent(angle, ulps):
    """(0, 1) = ((1, angle) − (1, 0)) / angle: weights of 1/angle make (2/angle)² roundings of a mobility of zero."""
    J = np.array([[1.0, 0.0], [1.0, angle], [0.0, 1.0]])
    W = J @ J.T
    W[0, 0] += ulps * ULP
    factor, row, count = factored(W)
    assert count == 2
    left = mobility_left(factor, W, row, count, 2)
    rounding = rounding_left(factor, W, row, count, 2)
    assert abs(left) <= rounding
    assert rounding == pytest.approx(ROUNDINGS * (1.0 + 2.0 / angle) ** 2, rel=1e-2)
    assert extended(factor, W, row, count, 2) == 2


def test_row_that_nearly_depends_on_others_is_told_from_rounding():
    """Its own part of the mobility is 1e-7 of it: below the limit of rows, far above rounding."""
    J = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, np.sqrt(2e-7)]])
    W = J @ J.T
    factor, row, count = factored(W)
    left = mobility_left(factor, W, row, count, 2)
    assert left == pytest.approx(2e-7, rel=1e-6)
    assert 1e5 * rounding_left(factor, W, row, count, 2) < left < NEARLY_DEPENDENT * W[2, 2]
    assert extended(factor, W, row, count, 2) == 3
