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
    """A base on two driven wheels and a caster ([WM] II.E); its frame: on the ground below the axle, x ahead.

    Attributes
    ----------
    body : name of the link that carries it
    wheels : joints of the left and of the right wheel; a positive rate rolls ahead
    wheel_radius : r [m]; track : T, between the wheels' contact points [m]
    caster : (3,) where the caster touches the ground, in the base's frame [m]
    spin_inertia : of one wheel about its axle [kg m²]
    wheel_friction : μ between wheels and ground, for the traction demand
    stop_on_overturn : whether a run ends when the base tips; else it continues with a base that cannot tip
    """

    body: str
    wheels: tuple[str, str]
    wheel_radius: float
    track: float
    caster: Array
    spin_inertia: float
    wheel_friction: float = 0.8
    stop_on_overturn: bool = False
