"""Every key of the scenario schema is in a shipped scenario, and a key that is changed there changes the run.

A key is a field of a configuration class. A field that a class inherits counts as a key of the class that declares it:
``mass_kg`` of a motor is one key for all types of motors, and ``mass_kg`` of a link is another key.
"""

from __future__ import annotations

import re
import typing
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

import dynsim
from dynsim.errors import DynsimError
from dynsim.library.families import MemberField
from dynsim.scenario import ScenarioConfig, shipped_scenarios
from dynsim.scenario.reading import read_scenario
from dynsim.scenario.schema import Requirements


class Key(NamedTuple):
    """A field of a configuration class."""

    owner: type[BaseModel]
    name: str

    def __str__(self) -> str:
        return f"{self.owner.__module__.removeprefix('dynsim.')}.{self.owner.__name__}.{self.name}"


# Keys that no scenario file needs, and why.
EXCEPTIONS = {"scenario.schema.ScenarioConfig.variant": "written by dynsim into the scenario.yaml of a run"}

# These differ from run to run.
TIMINGS = ("integration_wall_s", "real_time_factor")


def key(model: type[BaseModel], name: str) -> Key:
    """The key of a field, with the class that declares it."""
    declaring = [base for base in model.__mro__ if name in getattr(base, "model_fields", {})]
    return Key(declaring[-1], name)


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Every configuration class that a value of this type can have in it."""
    if isinstance(annotation, MemberField):
        # Without those of plug-ins, which other tests import.
        yield from (model for model in annotation.models() if model.__module__.startswith("dynsim."))
    elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in (*typing.get_args(annotation), *getattr(annotation, "__metadata__", ())):
        yield from models_in(part)


def models_of(field: FieldInfo) -> Iterator[type[BaseModel]]:
    """Every configuration class that a value of the field can have in it."""
    for part in (field.annotation, *field.metadata):
        yield from models_in(part)


@cache
def schema_keys() -> dict[Key, bool]:
    """All keys of scenarios, and whether each is a section: a mapping or list of configurations."""
    keys: dict[Key, bool] = {}
    models, reached = [ScenarioConfig], set()
    while models:
        model = models.pop()
        if model not in reached:
            reached.add(model)
            for name, field in model.model_fields.items():
                inner = list(models_of(field))
                keys[key(model, name)] = bool(inner)
                models += inner
    return keys


def merged(base: Any, difference: Any) -> Any:
    """A variant's difference over the rest of the file; null removes."""
    if not (isinstance(base, Mapping) and isinstance(difference, Mapping)):
        return difference
    both = {name: merged(base.get(name), value) for name, value in difference.items()}
    return {name: value for name, value in {**base, **both}.items() if value is not None}


def written(config: Any, data: Any) -> Iterator[Key]:
    """Keys that ``data`` gives, the mapping or list from which ``config`` was read."""
    if isinstance(data, Mapping):
        for name, value in data.items():
            if isinstance(config, BaseModel):
                yield key(type(config), str(name))
                yield from written(getattr(config, str(name)), value)
            elif isinstance(config, Mapping):
                yield from written(config.get(name), value)
    elif isinstance(data, list) and isinstance(config, list | tuple):
        for part, value in zip(config, data, strict=True):
            yield from written(part, value)


@cache
def written_keys(name: str) -> frozenset[Key]:
    """Keys that a shipped scenario gives, in any of its variants."""
    file = read_scenario(name)
    shared = {name: value for name, value in file.data.items() if name != "variants"}
    differences = file.data.get("variants") or {None: {}}
    return frozenset(
        each
        for variant, difference in differences.items()
        for each in written(file.load(variant).config, merged(shared, difference or {}))
    )


def test_every_key_is_in_a_shipped_scenario() -> None:
    shipped = frozenset[Key]().union(*(written_keys(path.stem) for path in shipped_scenarios()))
    missing = {str(each) for each in schema_keys().keys() - shipped}
    # The motors of the catalogue have the keys of a servo; the types of all but a few are in no scenario.
    missing = {name for name in missing if not name.startswith("library.motors.catalogue.")}
    assert missing == set(EXCEPTIONS)


class With(NamedTuple):
    """A value that needs other keys too; both runs have them."""

    value: Any
    together: dict[str, Any]


class Instead(NamedTuple):
    """A mapping in the place of the section that has the key."""

    section: str
    value: Any


class Content(NamedTuple):
    """Of another file."""

    text: str


# Lists of the snake that fit any number of joints.
ANY_SIZE = {"plant.wheel_gap_m": 0.13, "plant.driven_side": "left", "controller.cost_matrix": None}


# Another value of each key that only these scenarios give, by scenario, variant and dotted key. For ``type`` it is the
# mapping with the other type.
CHANGES: dict[tuple[str, str], dict[str, Any]] = {
    ("spring_drawer", "opens"): {
        "plant.link.damping_N_s_per_m": 40,
        "plant.chain.1.com_m": [0, 0, 0.2],
        "plant.chain.1.inertia_kg_m2": [0.01, 0, 0, 0.01, 0, 1e-3],
        "plant.chain.0.friction_N": 4,
        "plant.chain.0.limit_m": [0.399, 0.8],
        "plant.chain.0.initial_m": 0.45,
        "plant.chain.0.motor.coulomb_friction_N_m": 3,
        "plant.chain.1.friction_N_m": 0.1,
        "plant.chain.1.limit_deg": [20, 150],
        "objects.drawer.mass_kg": 3,
        "objects.trolley.size_m": [0.3, 0.2, 0.3],
        "objects.drawer.slide.friction_N": 5,
        "objects.drawer.slide.damping_N_s_per_m": 8,
        "objects.drawer.slide.limits_m": [0, 0.2],
        "objects.drawer.slide.spring_N_per_m": 60,
        "objects.drawer.slide.rest_m": 0.1,
        "objects.lid.radius_m": 0.2,
        "objects.lid.length_m": 0.05,
        "objects.lid.hinge.limits_deg": [-5, 10],
        "objects.lid.hinge.rest_deg": 20,
        "objects.trolley.wheels.front_left.position_m": [0.1, 0.11, -0.05],
        "objects.trolley.wheels.front_left.radius_m": 0.0495,
        "objects.trolley.wheels.front_left.mass_kg": 0.3,
        "objects.trolley.wheels.front_left.damping_N_m_s_per_rad": 0.02,
        "objects.trolley.wheels.front_right.friction_N_m": 0.04,
        "objects.trolley.wheels.rear_right.axis": [0.1, 1, 0],
        "ties.hook.type": {
            "type": "torsion",
            "body": "drawer",
            "other": "link_4",
            "axis": [0, 1, 0],
            "stiffness_N_m_per_rad": 1,
        },
        "ties.hook.body": "lid",
        "ties.bumper.point_m": [0.14, 0, 0.1],
        "ties.hook.other": "link_3",
        "ties.hook.other_point_m": [0, 0, 0.05],
        "ties.hook.axis": [1, 0, 0.2],
        "ties.hook.stiffness_N_per_m": 1000,
        "ties.hook.damping_N_s_per_m": 80,
        "ties.hook.bound_N": 10,
        "ties.hook.holds": False,
        "ties.bumper.rest_m": 0.02,
        "ties.bumper.pushes": False,
        "ties.friction_hinge.type": {
            "type": "linear",
            "body": "lid",
            "other": "world",
            "axis": [0, 0, 1],
            "stiffness_N_per_m": 10,
        },
        "ties.friction_hinge.stiffness_N_m_per_rad": 2,
        "ties.friction_hinge.bound_N_m": 0.5,
        "ties.seal.damping_N_m_s_per_rad": 0.1,
        "loads.lid_push.type": {"type": "constant", "body": "lid", "torque_N_m": [0, 1.0, 0]},
        "loads.lid_push.file": Content("t_s,fx_N,fy_N,fz_N\n0.2,0,0,0\n0.6,0,0,-2\n"),
        "loads.claw.type": {"type": "constant", "body": "link_4"},
        "loads.claw.mass_kg": 0.2,
        "loads.claw.radius_m": 0.05,
        "loads.tool.inertia_kg_m2": [1e-3, 1e-3, 1e-3],
        "loads.cable.type": {"type": "payload", "body": "link_3", "mass_kg": 0.1},
        "loads.cable.force_N": [-2, 0, 0],
        "loads.cable.torque_N_m": [0, 0.2, 0],
        "loads.hose.frame": "world",
        "loads.hose.torque_N_m": [[0, 0, 0], [0, -0.2, 0]],
        "loads.hose.hold": False,
        "contacts.stiffness_N_per_m": 5e4,
        "contacts.damping_N_s_per_m": 10,
        "integrator.step_s": 5e-4,
    },
    ("sampled_arm", "encoders"): {
        "plant.base.position_m": [0.0, 0.1, 0.3],
        "plant.chain.0.motor.nominal_current_A": 0.1,
        "plant.chain.0.motor.peak_current_A": 0.6,
        "plant.chain.1.motor.mass_kg": 0.4,
        "plant.chain.2.motor.mass_point_m": [0, 0.08, 0.2],
        "plant.chain.2.motor.nominal_torque_N_m": 0.1,
        "plant.chain.4.motor.type": With({"type": "mx_28"}, {"controller.torques": {}}),
        "plant.chain.4.motor.limit_N_m": 0.01,
        "controller.sample_time_s": 0.002,
        "controller.knot_spacing_s": 0.05,
        "controller.hand.path.origin_m": [0.5, 0, 0.245],
        "controller.hand.orientation.rpy_deg": [0, 95, 0],
        "controller.hand.path.type": {
            "type": "line",
            "from_m": [0.5, 0, 0.3],
            "to_m": [0.5, 0.1, 0.3],
            "duration_s": 1,
        },
        "controller.hand.path.times_s": [0.1, 0.6, 1.0, 1.4, 1.8],
        "controller.hand.path.points_m": [
            [0, 0, 0.06],
            [0, 0.1, 0],
            [0, 0, -0.06],
            [0, -0.06, 0],
            [0, 0, 0.06],
        ],
        "controller.torques.joint_5.times_s": [0.0, 0.6],
        "controller.torques.joint_5.torques_N_m": [0, -0.04],
        "sensors.encoders.resolution_deg": 0.1,
        "sensors.encoders.resolution_m": 1e-4,
        "sensors.encoders.noise_m": 5e-5,
        "initial.equilibrium": Instead("initial", None),
        "integrator.step_max_s": 1e-4,
    },
    ("sampled_arm", "servos"): {
        "plant.chain.1.motor.torque_limit_N_m": 1.8,
        "plant.chain.1.motor.nominal_current_A": 0.1,
        "plant.chain.2.motor.type": {"type": "mx_106"},
        "plant.chain.2.motor.voltage_V": 14,
        "plant.chain.2.motor.stall_torque_N_m": 5,
        "plant.chain.2.motor.no_load_speed_rad_per_s": 7,
        "plant.chain.2.motor.k_d_V_s_per_rad": 1,
        "plant.chain.2.motor.rotor_inertia_kg_m2": 0.004,
        "plant.chain.2.motor.gear_damping_N_m_s_per_rad": 0.1,
        "plant.chain.2.motor.coulomb_friction_N_m": 0.2,
        "plant.chain.2.motor.coulomb_speed_rad_per_s": 0.1,
        "plant.chain.2.motor.current_limit_A": 0.3,
        "plant.chain.4.motor.mode": Instead(
            "plant.chain.4.motor", {"type": "mx_28", "mode": "position", "k_p_V_per_rad": 40}
        ),
        "controller.joints.joint_5.ends": "free",
    },
    ("sampled_arm", "jogged"): {
        "controller.operator.rate_hz": 25,
        "controller.operator.rate_limit_rad_s": 0.1,
        "controller.operator.acceleration_limit_rad_s2": 0.5,
        "controller.operator.hand_acceleration_m_s2": 0.6,
        "controller.operator.tolerance_m": 1e-8,
    },
    ("sampled_arm", "dense"): {"integrator.solver": "articulated"},
    ("soft_floor", "rigid"): {
        "controller.hand.path.type": {
            "type": "line",
            "from_m": [1.41033, 0, 0.166374],
            "to_m": [1.4, 0.1, 0.2],
            "duration_s": 1,
        },
        "controller.hand.path.file": Content("t_s,x_m,y_m,z_m\n0,1.41033,0,0.166374\n2,1.4,0.1,0.2\n"),
        "controller.min_N": 8,
        "contacts.stribeck_m_s": 0.05,
        "contacts.viscous_friction_s_per_m": 1,
        "contacts.points.elbow.radius_m": 0.015,
        "contacts.points.elbow.static_friction": 0.8,
        "initial.on_references": False,
        "integrator.theta": 1,
    },
    ("soft_floor", "skate"): {
        "contacts.points.elbow.grip.axis": [1, 0, 0],
        "contacts.points.elbow.grip.ratio": 0.5,
    },
    ("soft_floor", "low_floor"): {
        "surface_error.shift_m": [0, 0, 0.005],
        "surface_error.friction_factor": 0.5,
        "initial.on_surface": [],
    },
    ("soft_floor", "moon"): {"plant.gravity_m_s2": [0, 0, -9.81]},
    ("soft_floor", "dropped"): {"contacts.points.elbow.restitution": 0},
    ("hand_over", None): {
        "controller.brace.elbow_1.during_s": [[0, 2.0]],
        "controller.brace.elbow_2.force_N": 2.5,
    },
    ("bench_arm", "heavy_tool"): {"mass_error.payload_factor": 1.0, "mass_error.robot_factor": 1.0},
    ("brace_on_shapes", "flat"): {"controller.hand.path.clockwise": False},
    ("brace_on_shapes", "block"): {
        "surfaces.ground.type": {"type": "plane", "point_m": [0, 0, -0.02]},
        "surfaces.ground.center_m": [0.69, 0.02, -0.1],
        "surfaces.ground.edges_m": [0.3, 0.08, 0.16],
        "surfaces.ground.rpy_deg": [5, 0, 0],
        "surfaces.ground.edge_radius_m": 0.01,
    },
    ("brace_on_shapes", "ball"): {
        "controller.hand.braces": [],
        "initial.keep": [],
        "surfaces.ground.type": {"type": "plane", "point_m": [0, 0, -0.02]},
        "surfaces.ground.center_m": [0.7, 0, -0.12],
        "surfaces.ground.radius_m": 0.12,
    },
    ("brace_on_shapes", "bowl"): {"surfaces.ground.inside": False},
    ("brace_on_shapes", "pipe"): {"surfaces.ground.inside": False},
    ("brace_on_shapes", "terrain"): {
        "surfaces.ground.type": {"type": "plane", "point_m": [0, 0, -0.02]},
        "surfaces.ground.file": Content("0,0,0,0,0,0,0,0\n" * 8),
        "surfaces.ground.spacing_m": [0.1, 0.12],
        "surfaces.ground.origin_m": [0.25, -0.4, -0.02],
    },
    ("brace_on_shapes", "jogged"): {
        "controller.operator.joints": ["joint_1", "joint_3", "joint_4", "joint_5"],
        "controller.operator.braces": [],
        "controller.operator.commands.0.at_s": 0.1,
        "controller.operator.commands.0.hand": [0, -0.1, 0],
    },
    ("mobile_turns", "arc"): {
        "plant.base.wheel.inertia_axle_kg_m2": 3e-4,
        "plant.base.wheel.inertia_across_kg_m2": 6e-4,
        "plant.base.mount.yaw_deg": 0,
        "controller.base.path.type": {"type": "straight", "distance_m": 0.5, "duration_s": 4},
        "controller.base.path.radius_m": 0.4,
        "controller.base.path.angle_deg": 45,
        "controller.base.path.start_s": 0,
        "controller.base.path.duration_s": 3,
    },
    ("mobile_turns", "straight"): {"controller.base.path.start_s": 0},
    ("mobile_turns", "recorded"): {
        "controller.base.path.type": {"type": "hold"},
        "controller.base.path.file": Content("t_s,x_m,y_m\n0,0,0\n2,0.4,0\n4,0.8,0\n"),
        "controller.base.path.frame": "world",
    },
    ("mobile_turns", "driven"): {
        "controller.operator.base_acceleration_m_s2": 1,
        "controller.operator.base_acceleration_rad_s2": 3,
        "controller.operator.commands.0.base": [0.25, -0.4],
    },
    ("corrected_arm", "fixed"): {
        "plant.base": "floating",
        "plant.links.upper_arm.mass_kg": 0.7,
        "plant.links.upper_arm.com_m": [0, 0, 0.13],
        "plant.links.upper_arm.inertia_kg_m2": [0.005, 0, 0, 0.005, 0, 0.0004],
        "plant.links.forearm.density_kg_m3": 1500,
        "plant.links.forearm.radius_m": With(
            0.05, {"surfaces.wall": {"type": "plane", "normal": [-1, 0, 0], "point_m": [0.1, 0, 0]}}
        ),
        "plant.joints.shoulder.damping": 0.2,
        "plant.joints.shoulder.friction": 0.1,
        "plant.joints.elbow.limit_deg": [5, 140],
        "plant.joints.grip.limit_m": [0.008, 0.03],
    },
    ("free_flyer", "cycle"): {
        "plant.gravity_m_s2": [0, 0, -0.1],
        "plant.initial_pose.root.position_m": [0, 0.5, 1],
        "plant.initial_pose.root.rpy_deg": [0, 0, 45],
        "plant.initial_m": {"rail": 0.05},
        "plant.lock_deg": {"wrist": -60},
        "plant.lock_m": {"left": 0.01},
        "plant.damping_N_m_s_per_rad": 2,
        "plant.damping_N_s_per_m": 50,
        "plant.friction_N_m": 0.2,
        "plant.friction_N": 4,
        "controller.joints.rail.positions_m": [0.1, 0, 0.1],
        "sensors.wrench": {"shoulder": {"body": "upper_arm"}},
        "sensors.wrench.elbow.body": With("carriage", {"sensors.wrench.elbow.frame": None}),
        "sensors.wrench.elbow.frame": None,
        "sensors.wrench.elbow.point_m": [0.1, 0, 0],
    },
    ("snake_short", "circle"): {
        "plant.yaw_joints": With(8, ANY_SIZE),
        "plant.head_joints": With(4, {**ANY_SIZE, "controller.shape_points_rad": {}}),
        "plant.link_length_m": 0.1,
        "plant.wheel_radius_m": 0.04,
        "plant.wheel_gap_m": 0.1,
        "plant.driven_side": "left",
        "plant.mass_kg": 9,
        "plant.initial_base_pose": [0, 0, 0],
        "controller.period_s": 0.005,
        "controller.rates_at": "middle",
        "controller.plant_substeps": 1,
        "controller.gain": 2,
        "controller.null_gain": 0.1,
        "controller.null_form": "safe",
        "controller.null_start_s": 0,
        "controller.weight_joint": 1,
        "controller.weight_wheel": 0.5,
        "controller.cost_angle_weight": 1,
        "controller.cost_support_weight_m": 0.1,
        "controller.cost_matrix": [10, 1, 10, 1, 10, 1, 1, 1, 1, 1],
        "controller.rate_limit_rad_s": 0.3,
        "controller.fixing_mode": 4,
        "controller.paths.0.profile": "smooth",
    },
    ("snake_short", "sideways"): {
        "plant.limits_deg.yaw": 40,
        "controller.limit_rate_per_s": 1,
        "controller.paths.0.turn_head": True,
        "controller.switching.release_fraction": 0.9,
    },
    ("snake_short", "backward"): {"controller.switching.prediction_step_s": 0.5},
    ("snake_short", "rises"): {"controller.damping_sigma": 0.1, "controller.damping_factor": 0.1},
    ("snake_short", "door"): {"controller.paths.0.hinge": "left", "controller.paths.0.profile": "smooth"},
    ("snake_short", "jogged"): {
        "plant.limits_deg.pitch": 111,
        "controller.paths.0.profile": "linear",
        "controller.commands_wait": True,
    },
    ("snake_pull", "holds"): {
        "plant.gripper_length_m": 0.085,
        "plant.gripper.hardening_s": 0.6,
        "plant.gripper.softening_s": 0.4,
        "plant.gripper.stiffness_N_per_m": 2e3,
        "plant.gripper.damping_N_s_per_m": 30,
        "plant.gripper.bound_N": 4.3,
        "plant.gripper.turning_stiffness_N_m_per_rad": 2,
        "plant.gripper.turning_damping_N_m_s_per_rad": 0.4,
        "plant.dynamics.joint_servo.type": {
            "type": "servo",
            "voltage_V": 12,
            "stall_torque_N_m": 9,
            "no_load_speed_rad_per_s": 4.71,
            "k_p_V_per_rad": 70,
        },
        "plant.dynamics.joint_servo.k_p_V_per_rad": 50,
        "plant.dynamics.wheel_servo.type": {"type": "mx_106", "mode": "velocity", "k_v_V_s_per_rad": 25},
        "plant.dynamics.wheel_servo.k_v_V_s_per_rad": 15,
        "plant.dynamics.wheel_inertia_kg_m2": 1e-4,
        "plant.dynamics.bearing_drag_N_m_s_per_rad": 1e-3,
        "plant.dynamics.passive_wheels": "bodies",
        "plant.dynamics.lifting.clearance_m": 0.012,
        "plant.dynamics.lifting.sag_compensation": True,
        "plant.dynamics.start": "released",
        "sensors.seed": 3,
        "sensors.motion_capture.rate_hz": 100,
        "sensors.motion_capture.delay_s": 0.02,
        "sensors.motion_capture.position_noise_m": 3e-4,
        "sensors.motion_capture.attitude_noise_rad": 1e-3,
    },
    ("snake_pull", "twists"): {"plant.gripper.turning_bound_N_m": 0.5},
    ("snake_pull", "shoved"): {"plant.dynamics.stops_deg.yaw": 65.5, "plant.dynamics.lifting.blend_s": 0.4},
    ("snake_pull", "encoders"): {"sensors.encoders.noise_deg": 0.1},
}
# Keys that limit a run: a value at which it is refused or stops, and a part of the message.
LIMITS: dict[tuple[str, str], dict[str, tuple[Any, str]]] = {
    ("corrected_arm", "fixed"): {"plant.inertia": ("strict", "plant.inertia: nearest")},
    ("sampled_arm", "encoders"): {
        "controller.hand.tolerance_m": (1e-17, "out of reach"),
        "controller.hand.path.frame": ("start", "out of reach"),
        "integrator.wall_limit_s": (1e-4, "integrator.wall_limit_s"),
        "record.size_limit_GB": (1e-6, "record.size_limit_GB"),
    },
    ("brace_on_shapes", "glued"): {"contacts.reference_tolerance_m": (1e-15, "contacts.reference_tolerance_m")},
    ("snake_pull", "holds"): {
        "plant.gripper.capture_m": (1e-5, "too_far"),
        "plant.gripper.capture_deg": (1e-3, "too_far"),
    },
    ("snake_pull", "slips"): {
        "plant.gripper.lost_m": (1e-4, "lost: handle has slipped"),
    },
    ("snake_pull", "twists"): {"plant.gripper.lost_deg": (0.1, "lost: handle has slipped")},
}

# Shorter runs that still show the effects.
DURATIONS = {("sampled_arm", "encoders"): 0.6, ("sampled_arm", "jogged"): 1.2}
# Scenarios whose keys take more than two seconds together: only every n-th is in the default tests.
EVERY = {"spring_drawer": 2, "sampled_arm": 6, "snake_pull": 10}
# No other default test compiles the kernels of the dense solver.
COMPILED_ALONE = ("integrator.solver",)


def cases(table: Mapping[tuple[str, str], Mapping[str, Any]]) -> list[Any]:
    """Parameters of a test: scenario, variant, dotted key, and what the table has for it."""
    count = dict.fromkeys((name for name, _ in table), 0)
    params = []
    for (name, variant), values in table.items():
        for path, value in values.items():
            late = count[name] % EVERY.get(name, 1) or path in COMPILED_ALONE
            marks = [pytest.mark.long] if late else []
            params.append(pytest.param(name, variant, path, value, id=f"{name}-{variant}-{path}", marks=marks))
            count[name] += 1
    return params


def run(name: str, variant: str, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """What a run gives: every signal, the events, and the summary without times and ratings."""
    duration = DURATIONS.get((name, variant))
    shorter = {} if duration is None else {"duration_s": duration}
    record = dynsim.simulate(dynsim.load_scenario(name, variant, {**shorter, **overrides}))
    signals = {signal: record[signal].tobytes() for signal in record}
    summary = {entry: value for entry, value in record.summary.items() if entry not in (*TIMINGS, "motors")}
    return {**summary, **signals, "events": [(event.time, event.kind, event.name) for event in record.events]}


@cache
def unchanged(name: str, variant: str) -> dict[str, Any]:
    """What the run of a variant gives, simulated once."""
    return run(name, variant, {})


def key_at(name: str, variant: str, path: str) -> Key:
    """The key that a dotted path means in a scenario."""
    *sections, last = path.split(".")
    config: Any = dynsim.load_scenario(name, variant).config
    for part in sections:
        if isinstance(config, BaseModel):
            config = getattr(config, part)
        else:
            config = config[int(part)] if isinstance(config, list | tuple) else config[part]
    return key(type(config), last)


def test_every_key_that_few_scenarios_give_is_changed_below() -> None:
    changed = {
        key_at(name, variant, path)
        for table in (CHANGES, LIMITS)
        for (name, variant), values in table.items()
        for path in values
    }
    names = {name for name, _ in CHANGES}
    others = {path.stem for path in shipped_scenarios()} - names
    here, elsewhere = (frozenset[Key]().union(*map(written_keys, group)) for group in (names, others))
    sections = {each for each, is_section in schema_keys().items() if is_section}
    # A section has an effect if one of its keys has; tests/verification/test_plan_requirements.py tests requirements.
    assert {str(each) for each in here - elsewhere - sections - changed if each.owner is not Requirements} == set()


@pytest.mark.parametrize("name", dict.fromkeys(name for name, _ in CHANGES))
def test_a_repeated_run_is_the_same(name: str) -> None:
    """Otherwise a change would prove nothing."""
    variant = next(each for scenario, each in CHANGES if scenario == name)
    assert run(name, variant, {}) == unchanged(name, variant)


@pytest.mark.parametrize(("name", "variant", "path", "change"), cases(CHANGES))
def test_a_key_that_is_changed_changes_the_run(name: str, variant: str, path: str, change: Any, tmp_path: Path) -> None:
    together: dict[str, Any] = {}
    section = path.removesuffix(".type")
    if isinstance(change, With):
        change, together = change
    if isinstance(change, Instead):
        section, change = change
    if isinstance(change, Content):
        file = tmp_path / "other.csv"
        file.write_text(change.text, encoding="utf-8")
        change = str(file)
    before = run(name, variant, together) if together else unchanged(name, variant)
    assert run(name, variant, {**together, section: change}) != before


@pytest.mark.parametrize(("name", "variant", "path", "limit"), cases(LIMITS))
def test_a_limit_that_is_changed_ends_the_run(name: str, variant: str, path: str, limit: tuple[Any, str]) -> None:
    value, message = limit
    with pytest.raises(DynsimError, match=re.escape(message)):
        run(name, variant, {path: value})
