"""Failing outputs in every state of a replay: the bytes on the line stay the same."""

from __future__ import annotations

import json
import random
import warnings
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from support.messages import check_message, mentions, says

from dynsim.errors import DynsimError
from dynsim.hardware.errors import OutputsFailed, PortError, ReplayAborted
from dynsim.hardware.replay.output import ReplayState, StopRequest, displayed
from dynsim.hardware.replay.session import run_replay, shown_by

from .conftest import TORQUE_ADDRESS, Rig, Run, swing
from .output_faults import AFTER, BEFORE, Call, Outputs, watched

pytestmark = pytest.mark.long

DEAD = {"kind": "drop_off", "id": 2, "at": 1.9}
ENDINGS: dict[str, dict[str, Any]] = {
    "regular": {},
    "decelerate": {"faults": [DEAD], "policy": "decelerate"},
    "hold": {"faults": [DEAD], "policy": "hold"},
    "off": {"faults": [DEAD], "policy": "off"},
    "on the way": {"faults": [DEAD | {"at": 0.8}], "policy": "decelerate", "struck": ReplayState.MOVE_TO_START},
    "unplugged": {"faults": [{"kind": "unplug", "at": 1.9}]},
    "interrupted": {"stop_at": 2.8},
}
# States in which the robot may be moving, or is being left: the loop must not wait for an output.
ARMED = [
    state.name
    for state in (
        ReplayState.ARM,
        ReplayState.MOVE_TO_START,
        ReplayState.SETTLE,
        ReplayState.REPLAY,
        ReplayState.DISARM,
        ReplayState.FAULT,
    )
]


class Case:
    """A replay with an ending, and what was on the wire."""

    def __init__(self, rig: Rig, ending: str, folder: Path, outputs: Outputs) -> None:
        options = ENDINGS[ending]
        self.struck = options.get("struck", ReplayState.REPLAY).name
        stop = StopRequest()
        short = Rig(rig.map, swing(duration=0.3))
        motion = short.motion()
        self.folder, self.outputs = folder, outputs
        self.run: Run = short.prepare(*options.get("faults", ()), motion=motion)
        if "stop_at" in options:
            now = self.run.clock.sleep_until

            def sleep_until(deadline: float) -> None:
                now(deadline)
                if deadline > options["stop_at"] and not stop.count:
                    stop()

            self.run.clock.sleep_until = sleep_until  # type: ignore[method-assign]
        self.error: BaseException | None = None
        self.warnings: list[warnings.WarningMessage] = []
        with watched(outputs) as console:
            try:
                with warnings.catch_warnings(record=True) as self.warnings:
                    warnings.simplefilter("always")
                    with shown_by(folder) as lost, displayed(console, lost) as observer:
                        self.result = run_replay(
                            motion,
                            short.map,
                            nullcontext((self.run.replay.bus, self.run.clock)),
                            folder,
                            policy=options.get("policy"),
                            live=True,
                            stop=stop,
                            observer=observer,
                        )
            except Exception as error:
                self.error = error

    @property
    def armed(self) -> bool:
        return bool(self.run.writes_of(TORQUE_ADDRESS))


@pytest.fixture(scope="module", params=ENDINGS)
def undisturbed(request: pytest.FixtureRequest, rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Case]:
    """A replay of every ending with all outputs well; in a folder where an earlier result is moved away."""
    folder = tmp_path_factory.mktemp("undisturbed")
    old_result(folder)
    case = Case(rig, request.param, folder, Outputs())
    assert case.armed
    if case.error is not None:
        assert isinstance(case.error, ReplayAborted)
        assert case.error.result.fault_state.name == case.struck
    return request.param, case


def old_result(folder: Path) -> None:
    for name in ("measured.part", "summary.json"):
        (folder / name).write_text("old", encoding="utf-8")


def test_the_loop_lets_nothing_out_while_the_robot_is_armed(undisturbed: tuple[str, Case]) -> None:
    """What it does not call can neither fail nor block it."""
    _, case = undisturbed
    seen = case.outputs.seen
    assert [call for call in seen if call.looping and call.state in ARMED] == []
    gone_through = {ReplayState.ARM.name, ReplayState.MOVE_TO_START.name, case.struck}
    assert {call.state for call in seen} >= {BEFORE, AFTER, *gone_through}, "other threads are at work in every state"


def check(rig: Rig, ending: str, expected: Case, call: Call, folder: Path) -> None:
    old_result(folder)
    outputs = Outputs(failing=call)
    case = Case(rig, ending, folder, outputs)
    assert outputs.failed, f"{call} did not happen"
    assert case.error is None or isinstance(case.error, DynsimError), repr(case.error)
    if case.run.sent != expected.run.sent:
        assert not case.armed, "not refused, and something else was sent"
        assert isinstance(case.error, PortError)
        check_message(case.error)
        return
    if expected.error is None:
        assert case.error is None or isinstance(case.error, OutputsFailed), repr(case.error)
    else:
        assert type(case.error) is type(expected.error)
    if not call.looping:
        messages = " ".join(map(str, [case.error, *case.warnings]))
        assert says(messages, "output failed"), "told to nobody"
        if call.place.startswith("output.py:Display"):
            summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
            assert "progress bar" in summary["outputs_failed"]
    if not (folder / "measured.h5").exists():
        assert mentions(case.error, "measured record")
        assert (folder / "measured.part").exists()


def calls(case: Case) -> list[Call]:
    return list(case.outputs.seen)


def test_some_outputs_fail(undisturbed: tuple[str, Case], rig: Rig, tmp_path: Path) -> None:
    ending, expected = undisturbed
    for number, call in enumerate(random.Random(ending).sample(calls(expected), 4)):
        folder = tmp_path / str(number)
        folder.mkdir()
        check(rig, ending, expected, call, folder)


@pytest.mark.slow
def test_every_output_fails_at_every_state(undisturbed: tuple[str, Case], rig: Rig, tmp_path: Path) -> None:
    ending, expected = undisturbed
    for number, call in enumerate(calls(expected)):
        folder = tmp_path / str(number)
        folder.mkdir()
        check(rig, ending, expected, call, folder)
