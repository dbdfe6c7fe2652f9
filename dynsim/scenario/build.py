"""What a scenario describes, built: its machine, controller, surfaces and contacts."""

from __future__ import annotations

from collections.abc import Callable
from typing import overload

import numpy as np

from dynsim import families
from dynsim.errors import ModelError, ScenarioError, shown
from dynsim.model.control import JointControl
from dynsim.model.description import Contact, Quadric, Robot
from dynsim.model.model import Model
from dynsim.model.protocols import BuildContext
from dynsim.model.snake import SnakeDescription, TaskSpaceController
from dynsim.problems import dotted, suggest
from dynsim.scenario.schema import Scenario

# A contact point must start this close to its surface [m].
START_TOLERANCE = 1e-6


def machine(scenario: Scenario) -> Robot | SnakeDescription:
    """What the plant of the scenario is, a tree of bodies or a snake."""
    if scenario.engine == "kinematic":
        return families.build("plant", scenario.plant, BuildContext(scenario.duration_s), SnakeDescription)
    return robot(scenario)


def robot(scenario: Scenario) -> Robot:
    """The tree of bodies with its motors.

    Raises
    ------
    ModelError
        The plant is none, or cannot be built.
    """
    if scenario.engine == "kinematic":
        raise ModelError(f"plant {scenario.plant.type!r} is kinematic: it has no rigid-body model")
    return families.build("plant", scenario.plant, BuildContext(scenario.duration_s), Robot)


def build_model(scenario: Scenario) -> Model:
    """The rigid-body model of a scenario's plant.

    Raises
    ------
    ModelError
        The plant has none, or is not physical.
    ScenarioError
        Not a scenario.
    """
    require_scenario(scenario)
    return Model(robot(scenario))


@overload
def controller(scenario: Scenario, machine: Model, progress: Callable[[float], None] | None = None) -> JointControl: ...
@overload
def controller(
    scenario: Scenario, machine: SnakeDescription, progress: Callable[[float], None] | None = None
) -> TaskSpaceController: ...
def controller(
    scenario: Scenario, machine: Model | SnakeDescription, progress: Callable[[float], None] | None = None
) -> JointControl | TaskSpaceController:
    """The controller for a machine; ``progress`` is called with the time [s] that its references have come to.

    Raises
    ------
    ModelError
        The scenario has none, it is for other machines, or does not fit this one.
    UnreachableReference
        The hand cannot follow its path.
    """
    config = scenario.controller
    if config is None:
        raise ModelError("the scenario has no controller; its motors are short-circuited")
    if scenario.engine != families.member("controller", config.type).ENGINE:
        raise ModelError(f"controller {config.type!r} cannot drive a {scenario.plant.type!r}")
    context = BuildContext(scenario.duration_s, machine, progress=progress)
    if isinstance(machine, Model):
        control = families.build("controller", config, context, JointControl)
        # The kernels would follow the last polynomial on.
        if control.end < scenario.duration_s * (1.0 - 1e-6):
            ends = f"end at {control.end:g} s, the run at {scenario.duration_s:g} s"
            raise ModelError(f"controller {config.type!r}: its references {ends}")
        return control
    return families.build("controller", config, context, TaskSpaceController)


def surfaces(scenario: Scenario) -> dict[str, Quadric]:
    """All surfaces by name, whether anything touches them or not."""
    context = BuildContext(scenario.duration_s)
    return {
        name: families.build("surface", config, context, Quadric) for name, config in scenario.config.surfaces.items()
    }


def contacts(scenario: Scenario) -> list[Contact]:
    """All enabled contact points with their surfaces.

    Raises
    ------
    ModelError
        A point on a surface that the scenario does not have.
    """
    options = scenario.config.contacts
    known = surfaces(scenario)
    result = []
    for name, point in options.points.items():
        if not point.enabled:
            continue
        if point.surface not in known:
            keys = ("contacts", "points", name, "surface")
            raise ModelError(
                f"{dotted(keys)} = {point.surface!r}: no such surface{suggest(point.surface, known)}; "
                f"surfaces: {', '.join(known) or 'none'}",
                keys=keys,
            )
        result.append(
            Contact(
                name=name,
                body=point.body,
                point=np.array(point.point_m),
                surface=known[point.surface],
                surface_name=point.surface,
                friction=options.friction if point.friction is None else point.friction,
                slip_smoothing=options.slip_smoothing_m_s,
                pulling_friction=options.pulling_friction,
            )
        )
    return result


def check_start(scenario: Scenario, model: Model) -> None:
    """Raise :class:`ModelError` unless every contact point is on a body of the robot and starts on its surface."""
    for contact in contacts(scenario):
        keys = ("contacts", "points", contact.name)
        try:
            position = model.point_position(contact.body, contact.point, model.robot.initial)
        except ModelError as error:
            raise ModelError(f"{dotted((*keys, 'body'))}: {error}", keys=(*keys, "body")) from error
        gap = contact.surface.gap(position)
        if not abs(gap) <= START_TOLERANCE:
            raise ModelError(
                f"{dotted(keys)}: its point starts {gap:+.4g} m from surface {contact.surface_name!r} "
                f"(limit {START_TOLERANCE:g} m), at {position.tolist()}; "
                "change the initial configuration or the surface, or disable the contact",
                keys=keys,
            )


def require_scenario(scenario: object) -> None:
    """Raise :class:`ScenarioError` for what is none, such as the name of one."""
    if not isinstance(scenario, Scenario):
        raise ScenarioError(f"needs a Scenario, not {shown(scenario)}; load_scenario(name or file) gives one")
