"""A scenario in the hands of a pilot: the arm or the snake."""

from __future__ import annotations

from dynsim.engine import named
from dynsim.errors import ScenarioError
from dynsim.scenario import Scenario, require_scenario
from dynsim.teleop.arm import DrivenArm
from dynsim.teleop.driven import Driven, Pace
from dynsim.teleop.snake import DrivenSnake


def drive(scenario: Scenario, *, pace: Pace | None = None, limit: float = 600.0) -> Driven:
    """A scenario to be driven: plant, surfaces, contacts and loads are its own, what moved its references is left out.

    Parameters
    ----------
    pace : fastest rates
    limit : longest drive [s]

    Raises
    ------
    ScenarioError
        The scenario has no controller that a pilot could take the place of.
    """
    require_scenario(scenario)
    with named(scenario):
        if scenario.controller is None:
            raise ScenarioError("it has no controller, so there is nothing to drive: a pilot gives its references")
        if scenario.engine == "kinematic":
            return DrivenSnake(scenario, pace or Pace(), limit)
        return DrivenArm(scenario, pace or Pace(), limit)
