"""Joints swing about their initial positions, the others hold; gains fade from the base to the hand."""

from __future__ import annotations

from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dynsim.compile.control import JointControl
from dynsim.compile.protocols import BuildContext
from dynsim.config.base import Positive, StrictConfig

ENGINE = "dynamics"


class Config(StrictConfig):
    """Gains of the first motor; those of the last are a tenth of them."""

    type: Literal["sway"]
    amplitudes: dict[str, float] = Field(default={}, description="by joint [rad, m at prismatic joints]")
    period_s: Positive = 2.0
    k_p_V_per_rad: Positive = 500.0
    k_d_V_s_per_rad: Positive = 20.0


def build(config: Config, context: BuildContext) -> JointControl:
    """q_d = q_0 + a (1 − cos ωt)/2 for every joint with an amplitude."""
    robot = context.model.robot
    initial = dict(zip(robot.joint_names, robot.initial[list(robot.position_index)], strict=True))
    fade = np.linspace(1.0, 0.1, len(robot.motors))

    def motion(joint: str, t: NDArray[np.float64]) -> NDArray[np.float64]:
        swing = 0.5 - 0.5 * np.cos(2.0 * np.pi * t / config.period_s)
        return initial.get(joint, 0.0) + config.amplitudes[joint] * swing

    return JointControl.following(
        robot,
        k_p=fade * config.k_p_V_per_rad,
        k_d=fade * config.k_d_V_s_per_rad,
        times=np.linspace(0.0, context.duration, 501),
        positions={joint: partial(motion, joint) for joint in config.amplitudes},
    )
