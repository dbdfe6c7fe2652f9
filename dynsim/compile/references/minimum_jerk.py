"""From rest to rest with the least integral of squared jerk."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def minimum_jerk(t: NDArray[np.float64], start: float, duration: float) -> NDArray[np.float64]:
    """s(x) = 10x³ − 15x⁴ + 6x⁵ with x = (t − start)/duration, 0 before and 1 after it."""
    x = np.clip((np.asarray(t) - start) / duration, 0.0, 1.0)
    return x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
