"""Description of a base on two driven wheels and a caster."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Supports of the base, in the order of the recorded loads.
SUPPORTS = ("left", "right", "caster")


@dataclass(frozen=True)
class MobileBase:
    """Base on two driven wheels and a caster ([WM] II.E); its frame is on the ground below the axle, with x forward.

    Attributes
    ----------
    body : str
        Name of the link that carries the base.
    wheels : tuple of str
        Joints of the left and of the right wheel; at positive rates the base rolls forward.
    wheel_radius, track : float
        Wheel radius r [m], and distance T between the wheels' contact points [m].
    caster : (3,) ndarray
        Contact point of the caster with the ground, in the base's frame [m].
    spin_inertia : float
        Inertia of one wheel about its axle [kg m²].
    wheel_friction : float
        Friction coefficient μ between wheels and ground, for the traction demand.
    stop_on_overturn : bool
        Whether a run ends when the base tips; otherwise it continues with a base that cannot tip.
    """

    body: str
    wheels: tuple[str, str]
    wheel_radius: float
    track: float
    caster: Array
    spin_inertia: float
    wheel_friction: float = 0.8
    stop_on_overturn: bool = False
