"""A pole on a cart that a motor drives along x."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import Positive, StrictConfig
from dynsim.library import families
from dynsim.model.description import Inertia, Link, Robot, vector
from dynsim.model.drives import Drive

ENGINE = "dynamics"

MotorChoice: Any = families.union("motor")


class Config(StrictConfig):
    """Cart and pole; the pole's angle is zero when it stands up."""

    type: Literal["cart_pole"]
    cart_kg: Positive = 1.0
    pole_kg: Positive = 0.1
    pole_m: Positive = 0.5
    initial_deg: float = 5.0
    motor: MotorChoice


def build(config: Config, context: BuildContext) -> Robot:
    """Bodies ``cart`` and ``pole``, joints ``slide`` and ``hinge``."""
    links = (
        Link("cart", "slide", None, "prismatic", vector(1, 0, 0), Inertia(config.cart_kg)),
        Link(
            "pole",
            "hinge",
            "cart",
            "revolute",
            vector(0, 1, 0),
            Inertia.solid_cylinder(config.pole_kg, 0.01, config.pole_m),
            p_PJ=vector(0, 0, 0.05),
        ),
    )
    return Robot(
        name="cart_pole",
        links=links,
        motors=(families.build("motor", config.motor, context.at_joint("slide"), Drive),),
        hand=("pole", vector(0, 0, config.pole_m)),
        q0=np.array([0.0, np.deg2rad(config.initial_deg)]),
    )
