"""Random fault schedules, and exceptions at every stage of the loop, of replays and drives by command.

One command runs the whole campaign and prints counts:

    pytest tests/hardware/test_loop_faults.py -m "long or slow" -n 0 -s
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest

from dynsim.hardware.replay.output import ReplayState

from .loop_faults import Schedule, Stage, Stages, broken_promises, drawn, files, run

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")

SCHEDULES = 300
DEAD = ({"kind": "drop_off", "id": 2, "at": 1.0},)
ENDINGS = {
    "replay": Schedule(),
    "drive": Schedule(driven=True),
    "decelerate": Schedule(faults=DEAD),
    "hold": Schedule(faults=DEAD, policy="hold"),
    "off": Schedule(faults=DEAD, policy="off"),
    "interrupted": Schedule(driven=True, presses=(1.3,)),
    "released": Schedule(presses=(1.3, 1.4)),
    "held": Schedule(at_end="hold"),
}
ERRORS = (ZeroDivisionError, ZeroDivisionError, MemoryError, OSError, RecursionError, KeyboardInterrupt)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("loop")
    files(folder)
    return folder


def stages_of(endings: list[str], source: Path, folder: Path) -> dict[Stage, tuple[str, int]]:
    """All stages, each with the first ending that passes it and the number of its passes."""
    stages: dict[Stage, tuple[str, int]] = {}
    for ending in endings:
        (folder / ending).mkdir()
        watch = Stages()
        ended = run(ENDINGS[ending], source, folder / ending, watch)
        assert list(broken_promises(ended)) == [], ending
        for stage, passes in watch.passed.items():
            stages.setdefault(stage, (ending, passes))
    return stages


def outcomes(stages: dict[Stage, tuple[str, int]], source: Path, folder: Path) -> Iterator[tuple[str, int | None]]:
    """Raise an error at each stage; yield the state and the exit code."""
    for stage, (ending, passes) in stages.items():
        draw = Random(str(stage))
        (there := folder / f"{len(list(folder.iterdir()))}").mkdir()
        watch = Stages(failing=stage, turn=draw.randint(1, passes), error=draw.choice(ERRORS)("out of the blue " * 20))
        ended = run(ENDINGS[ending], source, there, watch)
        assert watch.raised, str(stage)
        assert list(broken_promises(ended)) == [], f"{watch.error!r} at {stage}, turn {watch.turn}"
        # After the last cycle of a good motion a failure may concern an output only, but it is never silent.
        assert ended.code, f"{watch.error!r} at {stage}"
        yield stage.state, ended.code


def scheduled(numbers: range, source: Path, folder: Path) -> Iterator[tuple[str, int | None]]:
    """Run random schedules; yield the state in which each was struck and the exit code."""
    for number in numbers:
        (there := folder / f"schedule_{number}").mkdir()
        ended = run(schedule := drawn(number), source, there)
        assert list(broken_promises(ended)) == [], f"schedule {number}: {schedule}"
        result = None if ended.replay is None else ended.replay.result
        struck = "none" if result is None or result.fault_state is None else result.fault_state.name
        yield f"{'drive' if schedule.driven else 'replay'}, {struck}", ended.code


def show(title: str, counts: Counter[tuple[str, int | None]]) -> None:
    print(f"\n{title}: {counts.total()}")
    for (state, code), count in sorted(counts.items(), key=str):
        print(f"  {state:<24} exit code {code}: {count}")


@pytest.mark.long
def test_some_random_schedules_keep_all_promises(source: Path, tmp_path: Path) -> None:
    counts = Counter(scheduled(range(8), source, tmp_path))
    assert len({code for _, code in counts}) > 2


@pytest.mark.long
def test_an_exception_at_some_stages_keeps_all_promises(source: Path, tmp_path: Path) -> None:
    stages = stages_of(["decelerate"], source, tmp_path)
    # The stages come from the code; these are some that everybody knows.
    assert {
        Stage("machine.py:Loop.write_goals", "REPLAY", "call"),
        Stage("dynamixel_bus.py:DynamixelBus.sync_read", "REPLAY", "return"),
        Stage("rules.py:AbortRules.examine", "MOVE_TO_START", "call"),
        Stage("output.py:Recorder.add", "SETTLE", "call"),
        Stage("output.py:RunLog.write", "FAULT", "call"),
        Stage("machine.py:Ending._decelerate", "FAULT", "call"),
        Stage("machine.py:Ending._leave_holding", "FAULT", "return"),
        Stage("dynamixel_bus.py:DynamixelBus.close", "FAULT", "call"),
        Stage("session.py:_save", "FAULT", "call"),
    } <= set(stages)
    some = dict(Random(7).sample(sorted(stages.items()), 8))
    assert Counter(outcomes(some, source, tmp_path)).total() == 8


@pytest.mark.slow
@pytest.mark.parametrize("part", range(3))
def test_random_schedules_keep_all_promises(part: int, source: Path, tmp_path: Path) -> None:
    numbers = range(part * SCHEDULES // 3, (part + 1) * SCHEDULES // 3)
    show("random schedules", Counter(scheduled(numbers, source, tmp_path)))


@pytest.mark.slow
def test_an_exception_at_every_stage_keeps_all_promises(source: Path, tmp_path: Path) -> None:
    stages = stages_of(list(ENDINGS), source, tmp_path)
    assert {stage.state for stage in stages} >= {state.name for state in ReplayState} - {"DRY_RUN"}
    show("exceptions", Counter(outcomes(stages, source, tmp_path)))
