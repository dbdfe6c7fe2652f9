"""The commands: exit codes, one clear line for every mistake, files left behind."""

from __future__ import annotations

import json
import re
import sys
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, lines_with, mentions

from dynsim import cli
from dynsim.hardware.replay.output import HOLDING
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.servo_map import json_schema
from dynsim.record import Record

from .conftest import MAP, swing

SHIPPED = Path(__file__).parents[2] / "scenarios" / "hardware"


@pytest.fixture
def call(monkeypatch, capsys):
    """Run a command line in this process; (exit code, stdout, stderr)."""

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["dynsim", *map(str, arguments)])
        with pytest.raises(SystemExit) as leaving:
            cli.main()
        output = capsys.readouterr()
        return int(leaving.value.code or 0), output.out, output.err

    return run


@pytest.fixture
def files(tmp_path: Path) -> Path:
    swing().save(tmp_path / "record.h5")
    (tmp_path / "rig.yaml").write_text(MAP, encoding="utf-8")
    return tmp_path


def test_check_replay_compare_on_virtual_servos(call, files: Path) -> None:
    record, map_ = files / "record.h5", files / "rig.yaml"
    code, out, _ = call("hw", "check", record, "--map", map_)
    assert code == 0
    *_, passed, tightest = out.splitlines()
    check_message(passed)
    # The wheel at 3 of 5 rad/s and joints at 0.6 of 1.05 rad leave two fifths, joints at 0.6 · 4 of 3 rad/s one.
    assert mentions(tightest, re.compile(r"\w+: velocity -?2\.[34]\d+ rad/s"), "3.0000 rad/s", re.compile(r"\b2\d %"))
    code, out, _ = call("hw", "replay", record, "--map", map_, "--port", "virtual", "--out", files / "out")
    assert code == 0
    assert {path.name for path in (files / "out").iterdir()} == {
        "measured.h5",
        "summary.json",
        "replay.log",
        "registers.json",
    }
    log = (files / "out" / "replay.log").read_text(encoding="utf-8")
    states = [state for state, _ in groupby(line.split()[1] for line in log.splitlines())]
    assert states == ["CONNECT", "VERIFY", "ARM", "MOVE_TO_START", "SETTLE", "REPLAY", "SETTLE", "DISARM"]
    code, out, _ = call("hw", "compare", record, files / "out" / "measured.h5")
    assert code == 0
    assert (files / "out" / "comparison.png").exists()
    assert json.loads((files / "out" / "comparison.json").read_text(encoding="utf-8"))["delay_s"] > 0
    worst = (files / "out" / "comparison.png").read_bytes()
    names = Record.load(record).labels["q"]
    code, _, _ = call("hw", "compare", record, files / "out" / "measured.h5", "--joint", names[-1])
    assert code == 0
    assert (files / "out" / "comparison.png").read_bytes() != worst
    code, output, error = call("hw", "compare", record, files / "out" / "measured.h5", "--joint", "knee")
    assert output == ""
    assert code == 2
    check_message(error, re.compile("^error: "), "'knee'", ", ".join(names))
    (files / "gate.yaml").write_text("rms_rad: 0.001\n", encoding="utf-8")
    code, _, error = call("hw", "compare", record, files / "out" / "measured.h5", "--gate", files / "gate.yaml")
    assert code == 5
    check_message(error, re.compile("^error: "), "rms_rad", "0.001")


def test_exit_codes_of_refusal_verification_and_abort(call, files: Path) -> None:
    record, map_ = files / "record.h5", files / "rig.yaml"
    code, _, error = call("hw", "check", record, "--map", map_, "--speed", "3")
    assert code == 2
    assert lines_with(error, "shoulder", "velocity")
    options = ("--map", map_, "--port", "virtual", "--out", files / "out", "--quiet", "--faults", files / "faults.yaml")
    (files / "faults.yaml").write_text("faults: [{kind: wrong_model, id: 2, value: 12}]\n", encoding="utf-8")
    code, _, error = call("hw", "replay", record, *options)
    assert code == 3
    assert lines_with(error, "elbow (ID 2)", "12", "MX-106 (321)")
    (files / "faults.yaml").write_text("faults: [{kind: drop_off, id: 2, at: 1.0}]\n", encoding="utf-8")
    code, _, error = call("hw", "replay", record, *options)
    assert code == 4
    check_message(error, Cause.MISSED_STATUS, "elbow (ID 2)", "mixed: 2 holding; elbow does not answer")
    summary = json.loads((files / "out" / "summary.json").read_text(encoding="utf-8"))
    assert summary["fault"] == Cause.MISSED_STATUS
    assert not Record.load(files / "out" / "measured.h5").complete


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (("hw", "check", "nowhere.h5", "--map", "{map}"), "nowhere.h5: "),
        (("hw", "check", "{map}", "--map", "{map}"), "HDF5"),
        (("hw", "check", "{record}", "--map", "nowhere.yaml"), "nowhere.yaml: "),
        (("hw", "replay", "{record}", "--map", "{map}", "--port", "/dev/ttyNone", "--out", "{out}"), "/dev/ttyNone"),
        (("hw", "scan", "--port", "/dev/ttyNone"), "/dev/ttyNone"),
        (("hw", "stop", "--port", "/dev/ttyNone"), "/dev/ttyNone"),
        (("hw", "calibrate", "--map", "{map}", "--port", "/dev/ttyNone", "--joint", "knee"), "knee"),
        (
            ("hw", "calibrate", "--map", "arm", "--port", "/dev/ttyNone"),
            "--out",
        ),
        (("hw", "replay", "{record}", "--map", "{map}", "--port", "virtual", "--out", "{map}"), "rig.yaml"),
        (("hw", "compare", "{record}", "{map}"), "HDF5"),
        (("export", "{map}", "--format", "csv"), "HDF5"),
    ],
)
def test_mistakes_are_one_clear_line(call, files: Path, arguments: tuple[str, ...], name: str) -> None:
    names = {"map": files / "rig.yaml", "record": files / "record.h5", "out": files / "out"}
    code, _, error = call(*(argument.format(**names) for argument in arguments))
    assert code in (2, 3)
    assert error.startswith("error: ")
    check_message(error, name)
    assert len(error.strip().splitlines()) == 1


def test_the_schema_of_maps_is_printed(capsys, monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", ["dynsim", "hw", "schema"])
    with pytest.raises(SystemExit) as leaving:
        cli.main()
    assert not leaving.value.code
    assert json.loads(capsys.readouterr().out) == json_schema()


def test_export_writes_beside_the_record(call, files: Path) -> None:
    code, _, _ = call("export", files / "record.h5", "--format", "joint-trajectory", "--rate", 20)
    assert code == 0
    assert (files / "record.trajectory.yaml").exists()


@pytest.mark.parametrize(("robot", "servos"), [("arm", 10), ("snake", 24)])
def test_both_robots_replay_at_200_hz_on_the_virtual_bus(call, tmp_path: Path, robot: str, servos: int) -> None:
    """Synthetic swings here; the scenarios' own records in tests/scenarios."""
    from dynsim.hardware.servo_map import load_servo_map

    servo_map = load_servo_map(SHIPPED / f"{robot}.yaml")
    assert len(servo_map.servos) == servos
    time = np.arange(0.0, 1.0, 0.01)
    record = Record(time)
    signals: dict[tuple[str, str], list[str]] = {}
    for servo in servo_map.servos:
        if servo.hold_at is None:
            signals.setdefault((servo.kind.follows.position, servo.kind.follows.velocity), []).append(servo.label)
    for (position, velocity), labels in signals.items():
        amplitude = np.linspace(0.1, 0.2, len(labels))
        record.add(position, np.outer(1 - np.cos(3 * time), amplitude), "rad", labels=tuple(labels))
        record.add(velocity, np.outer(3 * np.sin(3 * time), amplitude), "rad/s", labels=tuple(labels))
    if servo_map.lifts:
        pairs = tuple(f"pair{k}" for k in range(1, 8))
        record.add(servo_map.lifts.signal, np.ones((len(time), 7)), "1", labels=pairs)
    record.save(tmp_path / "record.h5")
    code, out, error = call(
        "hw", "replay", tmp_path / "record.h5", "--map", SHIPPED / f"{robot}.yaml", "--port", "virtual", "--quiet",
        "--rate", 200, "--out", tmp_path / "out",
    )  # fmt: skip
    assert code == 0, error
    assert mentions(out, re.compile(r"\S*measured\.h5"))
    summary = Record.load(tmp_path / "out" / "measured.h5").summary
    assert summary["end_state"] == HOLDING
    assert (summary["timing"]["skipped_cycles"], summary["timing"]["missed_statuses"]) == (0, 0)
