"""Messages of runs with real contact: joint stops, chatter, falls of nanometres, refusals for mobile bases."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from support.messages import check_message, mentions, raises

import dynsim
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.engine import check, warnings
from dynsim.engine import recording as metrics
from dynsim.engine.prepare import Prepared, prepare
from dynsim.engine.stopping import _reason
from dynsim.errors import ModelError
from dynsim.integrators import run as ki
from dynsim.record import Record
from dynsim.scenario import Scenario, build

ARM = """\
duration_s: 1
plant:
  type: serial_arm
  base: {position_m: [0, 0, 2]}
  chain: [{axis: y, count: 2, length_m: 0.5, mass_kg: 1, limit_deg: [-10, 20]}]
surfaces: {floor: {type: plane}}
contacts: {law: unilateral, candidates: joints}
"""
BASE = """\
duration_s: 1
plant: {type: pws_arm, arm: {type: serial_arm, chain: [{axis: y, count: 2, length_m: 0.5, mass_kg: 1}]}}
surfaces: {floor: {type: plane}}
contacts: {law: unilateral, candidates: joints}
"""


def load(folder: Path, text: str, **overrides: Any) -> Scenario:
    path = folder / "case.yaml"
    path.write_text(text)
    return dynsim.load_scenario(path, overrides=overrides)


def test_time_stepping_on_a_mobile_base_is_refused_with_line_and_fix(tmp_path: Path) -> None:
    with raises(ModelError, "case.yaml:5", "integrator.method: auto", "time_stepping"):
        check(load(tmp_path, BASE + "integrator: {method: time_stepping}\n"))


def chattering(folder: Path, text: str) -> tuple[Scenario, Prepared]:
    """A run at its beginning that is told that it chatters."""
    scenario = load(folder, text)
    prepared = prepare(scenario)
    prepared.run.count[ki.STATUS] = ki.CHATTER
    prepared.workspace.contacts[:, ka.GAP] = 1.0
    return scenario, prepared


def test_chatter_names_flagged_contacts_else_those_that_changed_else_those_near_else_none(tmp_path: Path) -> None:
    scenario, prepared = chattering(tmp_path, ARM)
    names, law = [contact.name for contact in prepared.contacts], prepared.system.unilateral
    assert len(names) == 2
    assert law is not None
    said = _reason(scenario, prepared)
    check_message(said, "0 s", "time_stepping", "integrator.atol")
    assert not any(name in said for name in names)
    prepared.workspace.contacts[1, ka.GAP] = -1e-9
    assert [name for name in names if mentions(_reason(scenario, prepared), name)] == [names[1]]
    law.mode[0, ku.WANTED] = ka.STICKING
    assert [name for name in names if mentions(_reason(scenario, prepared), name)] == [names[0]]
    law.tally[1, ku.CHATTERED] = 1.0
    assert [name for name in names if mentions(_reason(scenario, prepared), name)] == [names[1]]


def test_chatter_on_a_mobile_base_does_not_advise_what_is_refused_there(tmp_path: Path) -> None:
    assert "time_stepping" in _reason(*chattering(tmp_path, ARM))
    said = _reason(*chattering(tmp_path, BASE))
    assert "time_stepping" not in said
    assert mentions(said, "integrator.atol")


def beyond(robot: dynsim.model.description.Robot, degrees: float) -> Record:
    """Two samples, in the second of which the first joint is there."""
    record = Record([0.0, 0.5])
    q = np.zeros((2, 2))
    q[1, 0] = np.radians(degrees)
    record.add("q", q, "rad", labels=robot.joint_names)
    record.add("v", np.zeros((2, 2)), "rad/s", labels=robot.joint_names)
    record.add("torque", np.zeros((2, 0)), "N m", labels=())
    return record


def test_stops_that_are_enforced_are_not_advised_to_be(tmp_path: Path) -> None:
    robot = build.robot(load(tmp_path, ARM))
    (glued,), (real,) = (warnings._passed_limits(beyond(robot, -10.5), robot, law) for law in (False, True))
    both = ("joint_1", "-10°", "-0.1745 rad", "0.5°", "0.00873 rad", "0.5 s")
    check_message(glued, *both, "contacts.law: unilateral")
    check_message(real, *both, "integrator.step_s")
    assert real.count("0.5°") == 2  # it is still beyond its stop at the end


def test_a_joint_that_is_back_at_its_stop_is_not_called_beyond(tmp_path: Path) -> None:
    robot = build.robot(load(tmp_path, ARM))
    record = beyond(robot, -10.5)
    record["q"][:] = record["q"][::-1]
    (real,) = warnings._passed_limits(record, robot, True)
    check_message(real, "joint_1", "-10°", "-0.1745 rad", "0.5°", "0.00873 rad", "0 s", "integrator.step_s")
    assert real.count("0.5°") == 1


def test_a_fall_of_nanometres_does_not_alarm_the_ledger(tmp_path: Path) -> None:
    """A block on a slide has no length: what finding its landing to 1e-13 m leaves is its weight times that."""
    block = ARM.replace("{axis: y, count: 2, length_m: 0.5, mass_kg: 1, limit_deg: [-10, 20]}",
                        "{kind: prismatic, axis: z, length_m: 0, mass_kg: 3}")  # fmt: skip
    robot = build.robot(load(tmp_path, block))
    record = Record([0.0, 1.0])
    for name in ("energy_kinetic", "energy_potential", "energy_magnetic"):
        record.add(name, np.zeros(2), "J")
    weight = 3 * 9.81
    assert metrics.residual_floor(record, robot, 1e-6) == 0.0
    floor = metrics.residual_floor(record, robot, 1e-6, True)
    assert weight * ku.AT_ROOT / floor < metrics.RESIDUAL_LIMIT
    # A fall of a millimetre is told by its own turnover.
    assert floor < 1e-2 * weight * 1e-3
