"""The fault table of docs/hardware/faults.md: each cell holds, and equals the end of a fresh run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from studies.fault_table import CASES, POLICIES, STATES, TORQUE_ADDRESS, broken_promises, cells, markdown, rig

from dynsim.hardware.bus.packet import Instruction, Packet

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
KEPT = json.loads((ROOT / "results/reference/bridge_faults.json").read_text(encoding="utf-8"))["cells"]


def cell_of(fault: str, state: str, policy: str) -> dict:
    return next(cell for cell in KEPT if (cell["fault"], cell["state"], cell["policy"]) == (fault, state, policy))


@pytest.mark.parametrize("runs", [1, pytest.param(10, marks=pytest.mark.slow)])
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_fresh_runs_of_every_cell(case, runs):
    """Seeds that the kept table does not have."""
    for cell in cells(runs, [case], first=1000):
        fresh, kept = cell.as_dict(), cell_of(cell.case, cell.state, cell.policy)
        assert fresh["broken"] == [], cell
        # An end rarer than one run in a hundred may be missing in the table; an end in all its runs must occur.
        if len(kept["ends"]) == 1:
            assert fresh["ends"].keys() == kept["ends"].keys()
        if kept["cycles_max"] is not None and fresh["cycles_max"] is not None:
            assert fresh["cycles_max"] <= 2 * kept["cycles_max"] + 2


def test_the_kept_table_is_whole_and_has_no_broken_promise():
    expected = {
        (case.name, state, policy)
        for case in CASES
        for state in (STATES if case.scripted_onset else ("VERIFY",))
        for policy in POLICIES
    }
    assert {(cell["fault"], cell["state"], cell["policy"]) for cell in KEPT} == expected
    assert all(cell["runs"] == 100 and not cell["broken"] for cell in KEPT)


def test_the_documents_have_the_kept_table():
    assert markdown(KEPT) in (ROOT / "docs/hardware/faults.md").read_text(encoding="utf-8")


def test_broken_promises_are_seen():
    run = rig().prepare({"kind": "overload", "id": 2, "at": 0.6}, policy="hold")
    run.result = run.replay.run()
    assert list(broken_promises(run)) == []
    run.line.servos.registers[1]["torque_enable"] = 0
    assert list(broken_promises(run)) == ["shoulder is not as reported (holding)"]
    time, id_, value = run.result.policy_goals[0]
    run.result.policy_goals[0] = (time, id_, value + 1)
    assert "a goal after the fault that was not the policy's" in list(broken_promises(run))
    torque_on = Packet(1, Instruction.WRITE, bytes([TORQUE_ADDRESS, 0, 1]))
    run.sent.append((run.result.fault_time + 0.1, torque_on))
    assert "torque was switched on after the fault" in list(broken_promises(run))
