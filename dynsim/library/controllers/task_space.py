"""Task-space controller of the articulated mobile robot (Tanaka et al. 2019, III.B, IV.C).

This module defines the keys and defaults; the control law is in :mod:`dynsim.snake.controller`.

[T]: M. Tanaka et al., "Task-Space Control of Articulated Mobile Robots With a Soft Gripper for Operations", IEEE
Transactions on Robotics 35(1), 2019. Values that [T] does not give are marked "assumed".
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, StrictInt, field_validator, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import NonNegative, Positive, StrictConfig, default, error_at
from dynsim.errors import ModelError
from dynsim.jit.kernel import integers, reals
from dynsim.library.controllers.snake_commands import STATES as MODE_STATES
from dynsim.library.controllers.snake_commands import Script, ScriptedSource, TimedScript
from dynsim.model.description import Array
from dynsim.snake import controller
from dynsim.snake import support as stability
from dynsim.snake import ticks as ss
from dynsim.snake.controller import ControlLaw, control_input, new_work
from dynsim.snake.description import ModeTable, Policy, SnakeDescription, TaskSpaceController, conditioning
from dynsim.snake.kinematics import SnakeModel, pose_of_point
from dynsim.snake.support import Cost
from dynsim.snake.ticks import Schedule

ENGINE = "kinematic"

COSTS = {"eq19": stability.COST_ANGLES, "eq20": stability.COST_SUPPORT_NORM, "eq20_min": stability.COST_SUPPORT_MIN}
LIMIT_POLICIES = {
    "none": controller.LIMITS_NONE,
    "saturate": controller.LIMITS_SATURATE,
    "allocate": controller.LIMITS_ALLOCATE,
}
STATES = {"measured": ss.MEASURED, "estimated": ss.ESTIMATED, "feedforward": ss.FEEDFORWARD}
FORMS = {"paper": controller.NULL_PAPER, "safe": controller.NULL_SAFE}


# [T] Table II: mode number -> lifted wheel pairs of the base part (pair 1 is next to the head part).
TABLE_II: dict[int, list[int]] = {1: [3, 6], 2: [6, 7], 3: [5, 6], 4: [4, 5], 5: [3, 4], 6: [2, 3]}


class Switching(StrictConfig):
    """Switching state ([T] IV.C.5), entered by a command with `mode: switching`."""

    policy: Policy = default(
        "cyclic",
        "choice of the next mode; `fixed`: never switch, `cyclic`: in the order of [T], `predictive`: "
        "lowest predicted cost",
    )
    order: list[StrictInt] = default(
        [2, 3, 4, 5, 6], "mode numbers: the order of `cyclic` and the candidates of `predictive`", min_length=1
    )
    period_s: Positive = default(1.0, "switching period Delta T")
    least_margin_m: float = default(
        0.0, "minimum support margin; a mode with a smaller or equal margin counts as tipping"
    )
    when_blocked: bool = default(
        False, "enter the switching state automatically when a command cannot be executed; the target waits"
    )
    release_fraction: Annotated[float, Field(gt=0, lt=1)] = default(
        0.6,
        "when_blocked: leave the switching state once every base joint is within this fraction of its limit (assumed)",
    )
    prediction_step_s: Positive = default(0.02, "time step of the prediction (assumed)")


class Config(Script):
    """Task-space controller of the snake; SI units unless the key has another unit."""

    type: Literal["task_space"] = "task_space"
    period_s: Positive = default(0.005, "control period (assumed)")
    rates_at: Literal["middle", "start"] = default(
        "middle", "instant of the period for which the held rates are computed (assumed)"
    )
    plant_substeps: int = default(1, "integration steps of the kinematic plant per period", ge=1, le=100)
    state: Literal["measured", "estimated", "feedforward"] = default(
        "measured",
        "state for the control law: `measured` pose, pose `estimated` from measured joint angles, or "
        "`feedforward` from commanded joint angles",
    )
    gain: Positive | list[Positive] = default(
        2.0, "gain K [1/s]: one value, or one per controlled variable (six, then the shape points)"
    )
    null_gain: NonNegative = default(0.1, "null-space gain k_eta")
    null_form: Literal["safe", "paper"] = default(
        "safe", "null-space motion; `paper`: eq 14, `safe`: eq 14 with W^-1 eta, which never increases the cost"
    )
    null_start_s: NonNegative = default(0.0, "start time of the null-space motion")
    weight_joint: Positive | list[Positive] = default(1.0, "weight W of the joint rates: one value, or one per joint")
    weight_wheel: Positive = default(0.01, "weight W of the active wheels; with large values the joint rates chatter")
    cost: Literal["eq19", "eq20", "eq20_min"] = default(
        "eq19",
        "null-space cost; `eq19`: joint angles, `eq20`: adds 1/norm of the signed support distances, as "
        "printed in [T], `eq20_min`: adds 1/smallest support distance, smoothed",
    )
    cost_matrix: list[NonNegative] | None = default(
        None, "diagonal of K_V; default: [T] V.B (head yaw 15, head pitch 0.015, base 9.6, 4.8, 2.4, ...)"
    )
    cost_angle_weight: NonNegative = default(1.0, "weight a_1 of the joint angles in eq 20 (assumed)")
    cost_support_weight_m: NonNegative = default(1.0, "weight a_2 of the support distances in eq 20 (assumed)")
    limit_policy: Literal["none", "saturate", "allocate"] = default(
        "allocate",
        "treatment of joint limits; `allocate`: a joint at its limit is excluded from the allocation, and "
        "the target waits if no solution is left, `saturate`: joints are clamped, `none`: limits are ignored",
    )
    rate_limit_rad_s: Positive = default(
        4.7, "maximum joint rate: no-load speed of the MX-106 at 12 V, 45 rpm (data sheet)"
    )
    limit_rate_per_s: Positive = default(
        20.0, "maximum joint rate towards a limit, per angle left to the limit [1/s] (assumed)"
    )
    damping_sigma: NonNegative = default(
        0.2,
        "singular value below which the weakest direction is damped, as a fraction of the smallest "
        "singular value of B W^-1/2 in the reference posture (head raised, base straight) (assumed)",
    )
    damping_factor: NonNegative = default(
        0.4, "damping at the singularity, as a fraction of the same singular value (assumed)"
    )
    shape_points_rad: dict[str, float] | None = default(
        None,
        "shape controllable points: target angle [rad] for each named joint; default: 110 deg for the last head joint",
    )
    modes: dict[int, list[int]] | None = default(None, "lifted wheel pairs for each mode number; default: [T] Table II")
    fixing_mode: StrictInt = default(1, "mode of the fixing state, also the mode at the start")
    commands_wait: bool = default(
        True,
        "commands are delayed while the target waits; false: commands keep their times, and motion that "
        "the target cannot follow is lost, as with a live operator",
    )
    switching: Switching = Field(default_factory=Switching, description="switching state")

    @field_validator("cost", mode="before")
    @classmethod
    def _cost_by_number(cls, value: Any) -> Any:
        return f"eq{value}" if value in (19, 20) and not isinstance(value, bool) else value

    @model_validator(mode="after")
    def _known_modes(self) -> Config:
        """Check that the table has all commanded modes, even the modes of commands after the end of the run."""
        table = TABLE_II if self.modes is None else self.modes
        for i, command in enumerate(self.commands):
            if isinstance(command.mode, int) and command.mode not in table:
                known = ", ".join(map(str, [*MODE_STATES, *table]))
                raise error_at(f"commands.{i}.mode", f"unknown mode {command.mode} (choices: {known})")
        return self


def build(config: Config, context: BuildContext) -> TaskSpaceController:
    """Build the controller for the snake in the context.

    Raises
    ------
    ModelError
        If lists or names do not fit the robot, or the robot is not controllable in a mode (see
        :func:`check_controllable`).
    """
    plant = context.snake
    model = plant.arrays()
    joints, inputs = len(plant.joint_names), len(plant.joint_names) + model.wheels
    shape_joints, shape_target = _shape_points(config, plant, model)
    needed = max(pair for lifted in TABLE_II.values() for pair in lifted)
    if config.modes is None and plant.pairs < needed:
        raise ModelError(
            f"controller.modes: the default table ([T] Table II) needs {needed} wheel pairs, but this robot has "
            f"{plant.pairs}; set controller.modes, e.g. {{1: []}}, and controller.switching.order, e.g. [1]"
        )
    modes = ModeTable.from_lifted(TABLE_II if config.modes is None else config.modes, plant.pairs)
    fixing_row = modes.row(config.fixing_mode, "controller.fixing_mode")
    order = tuple(modes.row(number, "controller.switching.order") for number in config.switching.order)

    diagonal = config.cost_matrix
    if diagonal is None:
        head = [0.015 if j % 2 else 15.0 for j in range(model.head_joints)]
        diagonal = head + [9.6 / 2**i for i in range(model.base_joints)]
    weights = np.ones(inputs) * config.weight_wheel
    weights[:joints] = _per_entry("weight_joint", config.weight_joint, joints)
    law = ControlLaw(
        gain=reals(_per_entry("gain", config.gain, 6 + len(shape_joints))),
        null_gain=config.null_gain,
        null_form=FORMS[config.null_form],
        root_weight_inverse=reals(1.0 / np.sqrt(weights)),
        shape_joints=integers(shape_joints),
        shape_target=reals(shape_target),
        grounded=integers(modes.grounded),
        limit_policy=LIMIT_POLICIES[config.limit_policy],
        rate_limit=config.rate_limit_rad_s,
        limit_rate=min(config.limit_rate_per_s, 1.0 / config.period_s),
        damping_sigma=config.damping_sigma,
        damping_factor=config.damping_factor,
        cost=Cost(
            kind=COSTS[config.cost],
            diagonal=reals(_per_entry("cost_matrix", diagonal, joints)),
            angle_weight=config.cost_angle_weight,
            support_weight=config.cost_support_weight_m,
            distance_floor=1e-3,
            smoothing=1e-3,
        ),
    )
    check_controllable(model, law, modes, fixing_row, plant)
    scale = reference_sigma(model, law, fixing_row, plant)
    law = law._replace(damping_sigma=config.damping_sigma * scale, damping_factor=config.damping_factor * scale)

    script = ScriptedSource(config.commands, config.paths)
    switch_ticks = max(1, round(config.switching.period_s / config.period_s))
    prediction_ticks = max(1, round(config.switching.period_s / config.switching.prediction_step_s))
    schedule = Schedule(
        period=config.period_s,
        midpoint=int(config.rates_at == "middle"),
        substeps=config.plant_substeps,
        state_source=STATES[config.state],
        null_start_tick=round(config.null_start_s / config.period_s),
    )
    return TaskSpaceController(
        law=law,
        schedule=schedule,
        prediction=schedule._replace(period=switch_ticks * config.period_s / prediction_ticks, midpoint=0, substeps=1),
        prediction_ticks=prediction_ticks,
        modes=modes,
        fixing_row=fixing_row,
        order=order,
        switch_ticks=switch_ticks,
        policy=config.switching.policy,
        least_margin=config.switching.least_margin_m,
        when_blocked=config.switching.when_blocked,
        release_fraction=config.switching.release_fraction,
        source=script if config.commands_wait else TimedScript(script),
    )


def reference_sigma(model: SnakeModel, law: ControlLaw, row: int, plant: SnakeDescription) -> float:
    """Return the smallest singular value of B~ W^(-1/2) with the head raised and the base straight.

    It depends on the number and length of the links and on the weights. The damping parameters are fractions of it.
    """
    work, pose, joints = new_work(model), np.zeros(6), reals(plant.reference_joints)
    pose_of_point(model, np.zeros(3), joints, work.frame, pose)
    return float(control_input(model, law, work, pose, joints, pose, np.zeros(6), row, 0.0))


def check_controllable(
    model: SnakeModel, law: ControlLaw, modes: ModeTable, fixing_row: int, plant: SnakeDescription
) -> None:
    """Check for every mode that A~ w~' = B~ u ([T] eq 9) has a solution for all w~'.

    The side-slip row of wheel pair 1 and the three ground-contact rows contain head joints only. Every shape
    controllable point of the head part fixes one of these joints, so n_h >= 4 ([T] eq 1) becomes n_h - m_h >= 4
    (3 in a mode that lifts pair 1). Any other loss of rank is detected numerically at seeded random postures: if the
    rank is deficient at all of them, it is deficient everywhere.

    Raises
    ------
    ModelError
        If a mode fails the check. The message contains the mode, the equation and the numbers.
    """
    n_h, n_b, names = model.head_joints, model.base_joints, plant.joint_names
    head_shape = [names[j] for j in law.shape_joints if j < n_h]
    random = np.random.default_rng(0)
    for row in range(len(modes.numbers)):
        mode, down = f"mode {modes.numbers[row]}", modes.grounded[row]
        lifted = int(np.sum(down == 0))
        lifted_active = int(np.sum((down == 0) & (model.wheel >= 0)))
        if n_b - lifted + model.wheels - lifted_active < 2:
            raise ModelError(
                f"{mode}: n_b - lifted pairs + n_w - lifted active wheels = {n_b} - {lifted} + {model.wheels} - "
                f"{lifted_active} < 2: A does not have full column rank ([T] eq 16); lift fewer wheels"
            )
        needed = 4 if down[0] else 3
        if n_h - len(head_shape) < needed:
            raise ModelError(
                f"{mode}: with shape controllable points {', '.join(head_shape)} only {n_h - len(head_shape)} of the "
                f"n_h = {n_h} head joints are free, but the ground-contact and side-slip rows that contain only head "
                f"joints need {needed} (more than [T] eq 1 requires); raise head_joints or remove shape points"
            )
        redundancy = n_h + lifted + lifted_active - 4 - len(law.shape_joints)
        if redundancy < 0:
            raise ModelError(
                f"{mode}: {-redundancy} more rows than inputs (n_h + lifted pairs + lifted active wheels - 4 - shape "
                f"points = {redundancy}): no joint and wheel rates satisfy all rows; lift wheels or remove shape points"
            )
        postures = [random.uniform(0.4 * model.lower, 0.4 * model.upper) for _ in range(4)]
        samples = [conditioning(model, law, row, np.zeros(3), phi) for phi in postures]
        rank_a, rank_b = max(c.rank_A for c in samples), max(c.rank_B for c in samples)
        if rank_a < 6 + len(law.shape_joints) or rank_b < samples[0].rows:
            raise ModelError(
                f"{mode}: rank of A is {rank_a} of {6 + len(law.shape_joints)}, rank of B is {rank_b} of "
                f"{samples[0].rows} at random postures: the controlled variables are not independent; change the mode "
                "or remove shape points"
            )
    start = conditioning(model, law, fixing_row, plant.initial_base_pose, plant.initial_joints)
    if start.rank_B < start.rows or start.rank_A < 6 + len(law.shape_joints):
        raise ModelError(
            f"mode {modes.numbers[fixing_row]}: the initial posture is singular (rank of A {start.rank_A}, rank of B "
            f"{start.rank_B} of {start.rows}); change plant.initial_joints_rad or the shape points"
        )


def _shape_points(config: Config, plant: SnakeDescription, model: SnakeModel) -> tuple[list[int], list[float]]:
    names = plant.joint_names
    points = config.shape_points_rad
    if points is None:
        points = {names[model.head_joints - 1]: float(np.deg2rad(110.0))}  # [T] IV.C.3
    for name, target in points.items():
        if name not in names:
            raise ModelError(f"controller.shape_points_rad: unknown joint {name!r} (joints: {', '.join(names)})")
        j = names.index(name)
        if not model.lower[j] <= target <= model.upper[j]:
            raise ModelError(
                f"controller.shape_points_rad: {name} = {target:.4f} rad exceeds its limit of {model.upper[j]:.4f} rad"
            )
    return [names.index(name) for name in points], list(points.values())


def _per_entry(key: str, value: float | list[float], count: int) -> Array:
    if isinstance(value, list) and len(value) != count:
        raise ModelError(f"controller.{key} must have {count} entries, got {len(value)}")
    return np.ones(count) * np.asarray(value)
