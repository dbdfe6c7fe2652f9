"""Recovery of measured data when the process of a replay died; the results of an earlier replay are kept apart."""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, mentions, raises

from dynsim.errors import RecordError
from dynsim.hardware.errors import OutputsFailed, PortError, ReplayAborted
from dynsim.hardware.replay import measured, output, session
from dynsim.hardware.replay.machine import Loop
from dynsim.hardware.replay.measured import recover
from dynsim.hardware.replay.output import PART, GrowingFile, ReplayResult, move_away, row_type
from dynsim.hardware.replay.session import run_replay
from dynsim.record import Record

from .conftest import Rig


def replay(rig: Rig, folder: Path, faults: Sequence[dict] = (), **options) -> ReplayResult:
    run = rig.prepare(*faults, **options)
    motion = rig.motion()
    return run_replay(motion, rig.map, nullcontext((run.replay.bus, run.clock)), folder, live=True)


@pytest.fixture(scope="module")
def streamed(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> tuple[Record, bytes]:
    """A whole measured record, and the streamed one that it has replaced."""
    folder = tmp_path_factory.mktemp("streamed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "_save", lambda *_: None)
        result = replay(rig, folder)
    return result.record, (folder / PART).read_bytes()


def same(record: Record, other: Record, count: int) -> None:
    assert set(record.signals) == set(other.signals)
    np.testing.assert_array_equal(record.time[:count], other.time)
    for name, signal in record.signals.items():
        np.testing.assert_array_equal(signal.data[:count], other[name], strict=True)
        assert (signal.unit, signal.labels) == (other.units[name], other.labels[name])


def test_nothing_is_left_of_the_stream_when_the_record_is_written(rig: Rig, tmp_path: Path) -> None:
    result = replay(rig, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"measured.h5", "summary.json", "replay.log", "registers.json"}
    same(result.record, Record.load(tmp_path / "measured.h5"), len(result.record))
    assert json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["outputs_failed"] == {}


def test_the_whole_stream_is_the_whole_record_but_incomplete(streamed, tmp_path: Path) -> None:
    record, stream = streamed
    (tmp_path / PART).write_bytes(stream)
    recovered = recover(tmp_path)
    same(record, recovered, len(record))
    assert not recovered.complete
    assert recovered.provenance == record.provenance
    assert [event.name for event in recovered.events] == [event.name for event in record.events]
    loaded = Record.load(tmp_path / "measured.h5")
    assert not loaded.complete
    same(record, loaded, len(record))
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["end_state"] == measured.END_STATE
    assert not (tmp_path / PART).exists()


def test_a_stream_cut_anywhere_keeps_its_whole_rows(streamed, rig: Rig, tmp_path: Path) -> None:
    record, stream = streamed
    head = stream.index(b"\n") + 1
    size = row_type(len(rig.map.servos)).itemsize
    assert len(stream) == head + size * len(record)
    for cut in (0, 1, size - 1, size, 100 * size + 7, len(stream) - head - 1):
        (tmp_path / PART).write_bytes(stream[: head + cut])
        recovered = recover(tmp_path)
        assert len(recovered) == cut // size
        # Time 0 of a run that never came to its path is its first cycle.
        started = np.isfinite(recovered["record_time"]).any()
        if started:
            same(record, recovered, cut // size)
        (tmp_path / "measured.h5").unlink()
    for cut in (1, head // 2, head - 2):
        (tmp_path / PART).write_bytes(stream[:cut])
        with raises(RecordError, "measured.part"):
            recover(tmp_path)
        assert (tmp_path / PART).exists()


def test_zeros_after_a_power_cut_are_no_cycles(streamed, rig: Rig, tmp_path: Path) -> None:
    record, stream = streamed
    size = row_type(len(rig.map.servos)).itemsize
    (tmp_path / PART).write_bytes(stream + bytes(3 * size))
    same(record, recover(tmp_path), len(record))


def test_rows_from_an_unknown_state_on_are_dropped(streamed, rig: Rig, tmp_path: Path) -> None:
    record, stream = streamed
    start = stream.index(b"\n") + 1
    rows = np.frombuffer(stream, row_type(len(rig.map.servos)), offset=start).copy()
    rows["state"][-5] = 99
    (tmp_path / PART).write_bytes(stream[:start] + rows.tobytes())
    same(record, recover(tmp_path), len(rows) - 5)


def test_a_record_that_is_whole_stays(streamed, tmp_path: Path) -> None:
    record, stream = streamed
    record.save(tmp_path / "measured.h5")
    before = (tmp_path / "measured.h5").read_bytes()
    (tmp_path / PART).write_bytes(stream[:-50_000])
    assert recover(tmp_path).complete == record.complete
    assert (tmp_path / "measured.h5").read_bytes() == before
    assert not (tmp_path / PART).exists()


def test_nothing_to_recover(tmp_path: Path) -> None:
    with raises(RecordError, str(tmp_path), "measured.part"):
        recover(tmp_path)


def test_an_empty_stream_is_said_to_be_empty(tmp_path: Path) -> None:
    (tmp_path / PART).touch()
    with raises(RecordError, "measured.part"):
        recover(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [PART]


def no_room(*_: object, **__: object) -> None:
    raise OSError(28, "No space left on device")


def no_thread(*_: object) -> None:
    raise RuntimeError("can't start new thread")


@pytest.mark.parametrize(
    ("owner", "method", "fault"),
    [(GrowingFile, "append", no_room), (threading.Thread, "start", no_thread), (output, "lock", no_room)],
)
def test_a_refused_start_leaves_no_empty_files(rig: Rig, tmp_path: Path, monkeypatch, owner, method, fault) -> None:
    run = rig.prepare()
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    monkeypatch.setattr(owner, method, fault)
    with raises(PortError, str(tmp_path)):
        run_replay(rig.motion(), rig.map, nullcontext((run.replay.bus, run.clock)), tmp_path, live=True)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    assert not run.sent


def test_a_stream_of_another_version_is_refused(streamed, tmp_path: Path) -> None:
    line, _, rows = streamed[1].partition(b"\n")
    header = json.loads(line)
    for change in ({"format": 1}, {"row": header["row"][1:]}, {"layout": {}}):
        (tmp_path / PART).write_bytes(json.dumps(header | change).encode() + b"\n" + rows)
        with raises(RecordError, "measured.part"):
            recover(tmp_path)


def test_who_looks_for_the_record_is_told_to_recover_it(streamed, tmp_path: Path) -> None:
    (tmp_path / PART).write_bytes(streamed[1])
    with raises(RecordError, "measured.h5", "measured.part", f"dynsim hw recover {tmp_path}"):
        Record.load(tmp_path / "measured.h5")


def test_a_stream_in_use_is_left_alone(tmp_path: Path) -> None:
    growing = GrowingFile("streamed record", tmp_path / PART, bytes)
    with raises(RecordError, "measured.part"):
        recover(tmp_path)
    with raises(PortError, str(tmp_path), "--out"):
        move_away(tmp_path)
    growing.close()
    assert move_away(tmp_path) == tmp_path / "previous_1"


def test_an_old_result_is_moved_away_whole_and_before_anything_is_written(rig: Rig, tmp_path: Path) -> None:
    names = ("measured.h5", "summary.json", "replay.log", "registers.json", "registers_after_fault.json", "INCOMPLETE")
    others = ("comparison.json", "comparison.png", "measured.part")
    for name in (*names, *others, "notes.txt"):
        (tmp_path / name).write_text(f"old {name}", encoding="utf-8")
    (tmp_path / "figures").mkdir()
    (tmp_path / "previous_1").mkdir()
    replay(rig, tmp_path)
    new = {"measured.h5", "summary.json", "replay.log", "registers.json"}
    assert {path.name for path in tmp_path.iterdir()} == {*new, "notes.txt", "previous_1", "previous_2"}
    moved = tmp_path / "previous_2"
    assert {path.name for path in moved.iterdir()} == {*names, *others, "figures"}
    assert all((moved / name).read_text(encoding="utf-8") == f"old {name}" for name in (*names, *others))
    assert mentions((tmp_path / "replay.log").read_text(encoding="utf-8"), str(moved))


def test_where_the_old_result_cannot_go_nothing_is_moved(rig: Rig, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "measured.h5").write_text("old", encoding="utf-8")
    run = rig.prepare()

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "rename", refuse)
    with raises(PortError, str(tmp_path), "Permission denied"):
        run_replay(rig.motion(), rig.map, nullcontext((run.replay.bus, run.clock)), tmp_path, live=True)
    assert not run.sent
    assert (tmp_path / "measured.h5").read_text(encoding="utf-8") == "old"


def test_a_killed_process_leaves_all_but_the_last_interval(rig: Rig, tmp_path: Path, monkeypatch) -> None:
    """The folder as it is at some instant is what a SIGKILL at that instant would leave."""
    monkeypatch.setattr(session, "INTERVAL", 0.02)
    cycles, exchange, part = 0, Loop.exchange, tmp_path / "run" / PART

    def rows_on_disk() -> int:
        _, _, rows = part.read_bytes().partition(b"\n")
        return len(rows) // row_type(len(rig.map.servos)).itemsize

    def watched(self, *arguments, **options):
        nonlocal cycles
        cycle = exchange(self, *arguments, **options)
        cycles += 1
        if cycles == 150:
            # Wall time passes, for the other thread; the loop's own clock stands still.
            while rows_on_disk() < 150:
                time.sleep(0.001)
            shutil.copytree(tmp_path / "run", tmp_path / "killed")
        return cycle

    monkeypatch.setattr(Loop, "exchange", watched)
    result = replay(rig, tmp_path / "run")
    recovered = recover(tmp_path / "killed")
    assert len(recovered) == 150
    np.testing.assert_array_equal(recovered["q_goal"], result.record["q_goal"][: len(recovered)])


def test_the_end_that_a_replay_has_told_is_kept(rig: Rig, tmp_path: Path, monkeypatch) -> None:
    """Its record could not be written; its summary could."""

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(measured, "replace_together", refuse)
        with raises(ReplayAborted, "elbow (ID 2)", "measured record", "No space left on device", "dynsim hw recover"):
            replay(rig, tmp_path, faults=[{"kind": "overload", "id": 2, "at": 1.7}])
    kept = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    recovered = recover(tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["end_state"] == "mixed: 2 holding; elbow limp: overload"
    assert kept["outputs_failed"].keys() == {"measured record"}
    assert {name: summary[name] for name in kept} == kept
    assert summary["recovered"]
    assert summary["timing"]["cycles"] == len(recovered)
    assert Record.load(tmp_path / "measured.h5").summary["servos"] == kept["servos"]


def test_a_complete_record_is_not_called_failed(rig: Rig, tmp_path: Path, monkeypatch) -> None:
    """What it replaces cannot be removed, or was not written."""

    unlink = Path.unlink

    def refuse(self: Path, missing_ok: bool = False) -> None:
        if self.name == PART:
            raise PermissionError(13, "Permission denied")
        unlink(self, missing_ok)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        with pytest.raises(OutputsFailed) as error:
            replay(rig, tmp_path / "left")
    check_message(error.value, "measured.part", "[Errno 13]", str(tmp_path / "left" / "measured.h5"))
    assert "recover" not in str(error.value)
    summary = json.loads((tmp_path / "left/summary.json").read_text(encoding="utf-8"))
    assert summary["outputs_failed"].keys() == {"removal of measured.part"}
    assert summary["timing"]["cycles"] == len(Record.load(tmp_path / "left/measured.h5"))
    with monkeypatch.context() as patch:
        patch.setattr(output.Recorder, "pending", no_room)
        with raises(
            OutputsFailed, "streamed record", "No space left on device", str(tmp_path / "streamed" / "measured.h5")
        ):
            replay(rig, tmp_path / "streamed")
    assert recover(tmp_path / "left").complete


def test_what_is_recovered_may_go_elsewhere(streamed, tmp_path: Path) -> None:
    source, out = tmp_path / "died", tmp_path / "new" / "folder"
    source.mkdir()
    (source / PART).write_bytes(streamed[1])
    same(streamed[0], recover(source, out), len(streamed[0]))
    assert [path.name for path in source.iterdir()] == [PART]
    assert not Record.load(out / "measured.h5").complete
    assert {path.name for path in out.iterdir()} == {"measured.h5", "summary.json"}
    before = (out / "measured.h5").read_bytes()
    with raises(RecordError, str(out), "measured.h5, summary.json", "--out"):
        recover(source, out)
    assert (out / "measured.h5").read_bytes() == before


def test_a_summary_that_was_cut_off_says_nothing(streamed, tmp_path: Path) -> None:
    (tmp_path / PART).write_bytes(streamed[1])
    (tmp_path / "summary.json").write_text('{"end_state": "hol', encoding="utf-8")
    assert recover(tmp_path).summary["end_state"] == measured.END_STATE
