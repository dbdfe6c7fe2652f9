"""Continuous voltage PD on joint references ([WM] eq 56): u = k_p (q_d − q) + k_d (v_d − v)."""

from __future__ import annotations

from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.interpolate import CubicSpline

from dynsim import families
from dynsim.config import NonNegative, Positive, StrictConfig
from dynsim.control.inverse_kinematics import follow
from dynsim.errors import ModelError
from dynsim.model.control import HandPath, JointControl
from dynsim.model.protocols import BuildContext

ENGINE = "dynamics"

PathChoice: Any = families.union("path")

# Of the reference splines: half a gigabyte for each joint.
SEGMENTS_MAX = 10_000_000


class HandReference(StrictConfig):
    """A path of the hand, turned into references of ``joints`` by inverse kinematics."""

    path: PathChoice
    joints: list[str] = Field(min_length=1, description="joints that follow the path; the others hold")
    tolerance_m: Positive = Field(default=1e-6, description="a target further off than this is unreachable")


class JointPath(StrictConfig):
    """Waypoints of one joint: a cubic spline, at rest at both ends and held beyond them."""

    times_s: list[float] = Field(min_length=2)
    angles_deg: list[float] = Field(min_length=2)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.times_s) != len(self.angles_deg):
            raise ValueError(
                f"{len(self.times_s)} times_s and {len(self.angles_deg)} angles_deg: there must be as many"
            )
        if np.any(np.diff(self.times_s) <= 0.0):
            raise ValueError("times_s must increase")
        return self


class Config(StrictConfig):
    """Gains for all motors or one per motor; joints without a reference hold their initial position."""

    type: Literal["joint_pd"]
    k_p_V_per_rad: NonNegative | list[NonNegative] = Field(default=500.0, description="V/m at a prismatic joint")
    k_d_V_s_per_rad: NonNegative | list[NonNegative] = Field(default=20.0, description="V s/m at a prismatic joint")
    hand: HandReference | None = Field(default=None, description="a path for the hand")
    joints: dict[str, JointPath] = Field(default={}, description="waypoints by joint name")
    knot_spacing_s: Positive = Field(default=0.02, description="distance of the knots of the reference splines")

    @model_validator(mode="after")
    def _check(self) -> Self:
        both = [name for name in self.joints if self.hand is not None and name in self.hand.joints]
        if both:
            raise ValueError(f"{both[0]} cannot follow both the hand path and waypoints of its own")
        return self


def build(config: Config, context: BuildContext) -> JointControl:
    """Resolve gains and references for the model of the context; long inverse kinematics report to its ``progress``.

    Raises
    ------
    ModelError
        A named joint does not exist or has no motor, or there are not as many gains as motors.
    UnreachableReference
        The hand cannot follow its path.
    """
    model, duration = context.model, context.duration
    robot = model.robot
    driven = [motor.joint for motor in robot.motors]
    named = [*config.joints, *(config.hand.joints if config.hand else ())]
    for name in named:
        if name not in driven:
            raise ModelError(f"controller: {name!r} is no joint with a motor; those are: {', '.join(driven) or 'none'}")
    for name in config.joints:
        if robot.links[model.joint_names.index(name)].kind != "revolute":
            raise ModelError(f"controller: {name!r} is prismatic; waypoints in angles_deg are for revolute joints")
    path, times, columns = None, np.zeros(0), []
    if config.hand is not None:
        path = families.build("path", config.hand.path, context, HandPath)  # type: ignore[type-abstract]
    if named:
        segments = duration / config.knot_spacing_s
        if segments > SEGMENTS_MAX:
            raise ModelError(
                f"controller.knot_spacing_s = {config.knot_spacing_s:g}: {segments:.3g} knots in {duration:g} s, "
                f"at most {SEGMENTS_MAX:g} are made; {duration / SEGMENTS_MAX:.3g} would fit"
            )
        # A quintic spline needs six knots.
        times = np.linspace(0.0, duration, max(int(np.ceil(segments)), 6) + 1)
        columns = [_waypoints(joint, times) for joint in config.joints.values()]
        if config.hand is not None and path is not None:
            hand, targets = config.hand, path.position(times)
            followed = follow(model, times, targets, hand.joints, robot.initial, hand.tolerance_m, context.progress)
            columns.extend(followed.T)
    return JointControl.following(
        robot,
        k_p=_per_motor(config.k_p_V_per_rad, driven, "k_p_V_per_rad"),
        k_d=_per_motor(config.k_d_V_s_per_rad, driven, "k_d_V_s_per_rad"),
        times=times,
        positions=dict(zip(named, columns, strict=True)),
        path=path,
    )


def _waypoints(path: JointPath, times: NDArray[np.float64]) -> NDArray[np.float64]:
    spline = CubicSpline(path.times_s, np.deg2rad(path.angles_deg), bc_type="clamped")
    return spline(np.clip(times, path.times_s[0], path.times_s[-1]))


def _per_motor(gain: float | list[float], driven: list[str], key: str) -> NDArray[np.float64]:
    if isinstance(gain, list):
        if len(gain) != len(driven):
            raise ModelError(f"controller: {key} has {len(gain)} values, there are {len(driven)} motors")
        return np.array(gain)
    return np.full(len(driven), gain)
