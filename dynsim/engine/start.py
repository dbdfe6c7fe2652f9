"""Start of a dynamics run: initial posture, gaps and tip margin, and the checks before the first step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from dynsim.compile.clearance import by_surface, sinking
from dynsim.compile.control import JointControl
from dynsim.compile.equilibrium import holding_torques, load_forces, static_margin
from dynsim.compile.model import Model
from dynsim.compile.shapes import gap_at
from dynsim.engine import Start, attended
from dynsim.engine.prepare import Prepared, at_start, prepare
from dynsim.engine.soundness import unstable_loop
from dynsim.engine.stopping import stopped
from dynsim.errors import ModelError
from dynsim.integrators import driver
from dynsim.integrators import run as ki
from dynsim.model.description import Array, Contact, Robot
from dynsim.scenario import Scenario, build
from dynsim.scenario.effect import without_effect
from dynsim.system import interruption
from dynsim.system.memo import recall

# A joint that the solution of the posture moves by less than this counts as unmoved [rad or m].
MOVED = 1e-12


def check(scenario: Scenario, started: Callable[[Start], None]) -> Start:
    """See :func:`dynsim.engine.check`."""
    start = start_of(scenario)
    started(start)
    prepared = prepare(scenario)
    control, model = prepared.control, prepared.model
    if prepared.balance is not None:
        # Compliant contacts are pressed in, which moves joints.
        points, gaps = _touching(model, prepared.contacts)
        hand = model.point_position(*model.robot.hand, model.robot.initial)
        said = [*start.warnings, *prepared.balance.warnings]
        start = replace(start, hand=hand, contacts=points, gaps=gaps, warnings=said)
    if (unstable := unstable_loop(scenario, prepared)) is not None:
        start = replace(start, warnings=[*start.warnings, unstable[0]])
    if control.path is not None and control.teleop is None:
        begin = control.path.position(np.zeros(1))[0]
        start = replace(start, off_path=float(np.linalg.norm(begin - start.hand)))
    _begin(scenario, prepared)
    return start


def commanded_by_python(scenario: Scenario, control: JointControl) -> bool:
    """Return whether Python code gives commands at ticks: an operator, the controller of a snake, or encoders."""
    sensors = scenario.config.sensors
    encoded = sensors is not None and sensors.encoders is not None
    return encoded or control.teleop is not None or control.task_space is not None


def _begin(scenario: Scenario, prepared: Prepared) -> None:
    """Choose contact modes and find forces at t = 0, as a run does before its first step.

    Not if Python code gives the first commands.

    Raises
    ------
    SimulationStopped
        If forces do not exist, or cannot last.
    """
    if not prepared.contacts or commanded_by_python(scenario, prepared.control):
        return
    attended.load(prepared)
    work = partial(driver.advance, prepared.system, prepared.workspace, prepared.run, 0)
    _, raised = attended.attend(work, lambda: None, interruption.check)
    if raised is not None:
        raise raised
    if prepared.run.count[ki.STATUS] not in (ki.RUNNING, ki.FINISHED):
        raise stopped(scenario, prepared)


def start_of(scenario: Scenario) -> Start:
    """Posture, gaps and margin at t = 0, whether they are allowed or not."""
    described, contacts, piloted = at_start(scenario)
    model = recall("model", lambda: Model(described), described)
    robot = model.robot
    q, (points, gaps) = robot.initial, _touching(model, contacts)
    declared = scenario.config.contacts.points
    movable = declared.keys() - {contact.name for contact in contacts if contact.left_out}
    if piloted is not None:  # a snake, whose joints `initial` does not place
        movable = set()
    aloft = [name for name, gap in gaps.items() if name in movable and abs(gap) > build.START_TOLERANCE]
    solved = {}
    if scenario.config.initial is not None and scenario.config.initial.on_surface:
        before = build.unposed(scenario).initial
        for link, k in zip(robot.links, robot.position_index, strict=True):
            if len(link.row.neutral) == 1 and abs(q[k] - before[k]) > MOVED:
                angle = link.units[0] == "rad"
                ends = np.array([q[k], before[k]])
                to, was = (np.degrees(ends) if angle else ends).tolist()
                solved[link.joint] = (to, was, "deg" if angle else "m")
    hand = model.point_position(*robot.hand, q)
    key = build.on_surface_key(scenario, aloft) if aloft else ""
    warnings = [
        *without_effect(scenario, bool(robot.motors)),
        *_below(scenario, robot),
        *build.left_out_warnings(scenario, contacts),
    ]
    return Start(hand, points, gaps, key, solved, *_margins(scenario, model, contacts), warnings)


def _touching(model: Model, contacts: Sequence[Contact]) -> tuple[dict[str, Array], dict[str, float]]:
    """Positions (3,) of contact points at the start, and their gaps [m]."""
    points, gaps, q = dict[str, Array](), dict[str, float](), model.robot.initial
    for contact in contacts:
        try:
            gaps[contact.name] = gap_at(model, contact, q)
        except ModelError:  # an unknown body, of which the check of contacts gives the line
            continue
        points[contact.name] = model.point_position(contact.body, contact.point, q)
    return points, gaps


def _below(scenario: Scenario, robot: Robot) -> list[str]:
    """A sentence for each surface that bodies begin below."""
    sunk = by_surface(sinking(robot, build.surfaces(scenario), robot.initial[None]))
    return [
        f"{', '.join(s.body for s in below)}: below {surface} at the start, by up to "
        f"{1e3 * max(s.depth for s in below):.3g} mm; surfaces hold only the points of contacts"
        for surface, below in sunk.items()
    ]


def _margins(scenario: Scenario, model: Model, contacts: Sequence[Contact]) -> tuple[float | None, float | None]:
    """Tip margin of a mobile base at rest, alone and with its braces; None where there is none."""
    robot, q = model.robot, model.robot.initial
    if robot.base is None:
        return None, None
    loads = build.loads(scenario, robot)
    forces = load_forces(model, q, loads)
    alone, able = static_margin(model, q, forces), [motor.joint for motor in robot.motors]
    try:
        balance = holding_torques(model, q, contacts, loads, able, scenario.config.contacts.law == "unilateral")
    except ModelError:
        return alone, None
    return alone, static_margin(model, q, [*forces, *balance.forces]) if balance.forces else None
