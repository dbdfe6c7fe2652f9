"""Choice of the teleoperation session for a scenario: arm or snake."""

from __future__ import annotations

from dynsim.engine import named
from dynsim.errors import ScenarioError
from dynsim.scenario import Scenario, require_scenario
from dynsim.teleop.arm import ArmSession
from dynsim.teleop.session import Session, SpeedLimits
from dynsim.teleop.snake import DynamicSnakeSession, SnakeSession


def begin(scenario: Scenario, *, limits: SpeedLimits | None = None, longest: float = 600.0) -> Session:
    """A session of a scenario, with its plant, surfaces, contacts and loads, without the motions of its references.

    Parameters
    ----------
    limits : fastest rates
    longest : time that the session may take [s]

    Raises
    ------
    ScenarioError
        The scenario has no controller that a pilot could take the place of.
    """
    require_scenario(scenario)
    with named(scenario):
        if scenario.controller is None:
            raise ScenarioError("it has no controller, so there is nothing to drive: a pilot gives its references")
        session: type[SnakeSession] | type[ArmSession] = ArmSession
        if scenario.controller.type == "task_space":
            session = SnakeSession if scenario.engine == "kinematic" else DynamicSnakeSession
        return session(scenario, limits or SpeedLimits(), longest)
