"""Table of features that a contact law or an integration method does not support.

Validation of a scenario rejects unsupported combinations of keys; preparation of a run rejects features of the robot,
such as dry friction from a URDF file. docs/limits.md prints the table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from dynsim.config.base import error_at
from dynsim.config.problems import dotted, listed
from dynsim.errors import ModelError
from dynsim.integrators import methods
from dynsim.library.families import engine
from dynsim.model.description import Robot
from dynsim.model.drives import Motor

LAWS = ("bilateral", "unilateral")
METHODS = ("auto", *methods.METHODS)
TIME_STEPPING = tuple(method.name for method in methods.METHODS.values() if not method.adaptive)
EVENT_DRIVEN = tuple(name for name in METHODS if name not in TIME_STEPPING)

# Keys of contacts and contact points that only one contact law uses.
BILATERAL_KEYS = ("slip_smoothing_m_s", "pulling_friction")
UNILATERAL_KEYS = (
    "static_friction",
    "stribeck_m_s",
    "viscous_friction_s_per_m",
    "restitution",
    "grip",
    "stiffness_N_per_m",
    "damping_N_s_per_m",
)
# Default of integrator.theta: the trapezoidal rule.
THETA = 0.5


@dataclass(frozen=True)
class Restriction:
    """Feature that only some contact laws and integration methods support.

    Attributes
    ----------
    feature : str
        Description of the feature for the table.
    reason : str
        Reason why the other laws and methods do not support the feature.
    laws, methods : tuple of str
        Contact laws and integration methods that support the feature.
    fix : str
        Fix other than changing the law or the method.
    keys : callable, optional
        Yields the dotted keys of a ScenarioConfig that use the feature.
    parts : callable, optional
        Returns the names of the robot's joints, ties or bases that use the feature.
    at : tuple of str
        Keys to which an error about the robot refers.
    """

    feature: str
    reason: str
    laws: tuple[str, ...] = LAWS
    methods: tuple[str, ...] = METHODS
    fix: str = "remove this key"
    keys: Callable[[Any], Iterator[str]] | None = None
    parts: Callable[[Robot], list[str]] | None = None
    at: tuple[str, ...] = ("plant",)

    def conflict(self, config: Any) -> str:
        """Return the requirement on law or method that the scenario does not meet, or "" if it meets both."""
        law, method = config.contacts.law, config.integrator.method
        if law not in self.laws:
            return f"requires contacts.law: {_either(self.laws)} (here: {law})"
        if method not in self.methods:
            return f"requires integrator.method: {_either(self.methods)} (here: {method})"
        return ""

    def message(self, conflict: str) -> str:
        """Return the text of an error."""
        change = "the law" if "contacts.law" in conflict else "the method"
        return f"{conflict}, because {self.reason}; {self.fix}, or change {change}"


def _either(names: tuple[str, ...]) -> str:
    return " or ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)


def _contact_keys(*names: str) -> Callable[[Any], Iterator[str]]:
    """Return a function that yields the keys with these names that are set in contacts or contact points."""

    def used(config: Any) -> Iterator[str]:
        sections = {"contacts": config.contacts}
        sections |= {f"contacts.points.{name}": point for name, point in config.contacts.points.items()}
        sections |= {f"contacts.between.{k}": pair for k, pair in enumerate(config.contacts.between)}
        for where, section in sections.items():
            for name in names:
                if name in section.model_fields_set and getattr(section, name, None) is not None:
                    yield f"{where}.{name}"

    return used


def _compliance(config: Any) -> Iterator[str]:
    # Resolved scenarios contain the default damping of 0, which does not count as use of the feature.
    yield from _contact_keys("stiffness_N_per_m")(config)
    if config.contacts.damping_N_s_per_m:
        yield "contacts.damping_N_s_per_m"
    yield from (
        f"contacts.points.{name}.damping_N_s_per_m" for name, p in config.contacts.points.items() if p.damping_N_s_per_m
    )
    yield from (
        f"contacts.between.{k}.damping_N_s_per_m" for k, p in enumerate(config.contacts.between) if p.damping_N_s_per_m
    )


def _key(key: str, used: Callable[[Any], bool]) -> Callable[[Any], Iterator[str]]:
    """Return a function that yields a key if the configuration uses the feature."""
    return lambda config: iter([key] if used(config) else [])


def _joints_with_dry_friction(robot: Robot) -> list[str]:
    joints = [link.joint for link in robot.links if link.friction > 0.0]
    return joints + [m.joint for m in robot.motors if isinstance(m, Motor) and m.dry_friction > 0.0]


WATCHED_EVENTS = Restriction(
    "`Simulation.watch`",
    "time stepping does not locate events within its steps",
    methods=EVENT_DRIVEN,
    fix="test the condition in Simulation.every()",
)
LINEARIZATION = Restriction(
    "`Simulation.linearize`",
    "time stepping chooses contact modes only for whole steps",
    methods=EVENT_DRIVEN,
    fix="start a Simulation with another method from this state",
)

RESTRICTIONS = (
    Restriction(
        "`integrator.method: time_stepping`",
        "time stepping has only contacts that push",
        laws=LAWS[1:],
        methods=TIME_STEPPING,
        fix="set `contacts: {law: unilateral}`, even if nothing touches",
        keys=_key("integrator.method", lambda config: config.integrator.method == "time_stepping"),
    ),
    Restriction(
        "smoothed slip direction, pulling friction (`contacts.slip_smoothing_m_s`, `contacts.pulling_friction`)",
        "real contacts stick, and cannot pull",
        laws=LAWS[:1],
        keys=_contact_keys(*BILATERAL_KEYS),
    ),
    Restriction(
        "static, Stribeck and viscous friction, restitution",
        "contacts that are held to their surfaces neither stick nor bounce",
        laws=LAWS[1:],
        keys=_contact_keys("static_friction", "stribeck_m_s", "viscous_friction_s_per_m", "restitution"),
    ),
    Restriction(
        "contact candidates `joints` and `links`",
        "the bilateral law would hold all of them to their surfaces",
        laws=LAWS[1:],
        keys=_key("contacts.candidates", lambda config: config.contacts.candidates != "points"),
    ),
    Restriction(
        "bodies that touch each other (`contacts.between`)",
        "the bilateral law would hold all of them together",
        laws=LAWS[1:],
        keys=_key("contacts.between", lambda config: bool(config.contacts.between)),
    ),
    Restriction(
        "friction that depends on direction (`grip`)",
        "the event-driven methods detect slip with one coefficient for all directions",
        laws=LAWS[1:],
        methods=TIME_STEPPING,
        keys=_contact_keys("grip"),
    ),
    Restriction(
        "compliant contacts (`stiffness_N_per_m`, `damping_N_s_per_m`)",
        "contacts of the event-driven methods are rigid",
        laws=LAWS[1:],
        methods=TIME_STEPPING,
        keys=_compliance,
    ),
    Restriction(
        "ties",
        "the event-driven methods have no bounded springs",
        laws=LAWS[1:],
        methods=TIME_STEPPING,
        keys=lambda config: (f"ties.{name}" for name in config.ties),
        parts=lambda robot: [tie.name for tie in robot.ties],
        fix="remove the tie",
    ),
    Restriction(
        "dry friction of joints",
        "friction that holds a joint at rest is a unilateral law",
        laws=LAWS[1:],
        parts=_joints_with_dry_friction,
        fix="set the friction to 0 and use damping",
    ),
    Restriction(
        "a mobile base",
        "time stepping does not locate events, so that it would miss the instant of overturning",
        methods=EVENT_DRIVEN,
        parts=lambda robot: [] if robot.base is None else [robot.base.body],
        fix="use a plant without a mobile base",
        at=("integrator", "method"),
    ),
    Restriction(
        "`integrator.solver: m_star`",
        "time stepping solves with articulated sweeps",
        methods=EVENT_DRIVEN,
        keys=_key("integrator.solver", lambda config: config.integrator.solver == "m_star"),
    ),
    Restriction(
        "`integrator.theta`",
        "it is a parameter of that method",
        methods=TIME_STEPPING,
        keys=_key("integrator.theta", lambda config: config.integrator.theta != THETA),
    ),
    WATCHED_EVENTS,
    LINEARIZATION,
)


def check_keys(config: Any) -> None:
    """Raise an error, for a pydantic validator, if the keys of a ScenarioConfig violate a restriction."""
    if config.contacts.between and engine(config.plant) == "kinematic":
        text = "requires plant.level: dynamic, because a kinematic plant has no forces; remove it or set the level"
        raise error_at("contacts.between", text)
    for restriction in RESTRICTIONS:
        if restriction.keys is None or not (conflict := restriction.conflict(config)):
            continue
        for key in restriction.keys(config):
            raise error_at(key, restriction.message(conflict))


def check_robot(config: Any, robot: Robot) -> None:
    """Raise ModelError if the parts of a robot violate a restriction."""
    for restriction in RESTRICTIONS:
        if restriction.parts is None or not (conflict := restriction.conflict(config)):
            continue
        if names := restriction.parts(robot):
            text = f"{dotted(restriction.at)}: {restriction.feature} ({listed(names)}) {restriction.message(conflict)}"
            raise ModelError(text, keys=restriction.at)
