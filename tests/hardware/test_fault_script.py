"""Fault scripts are checked against the servos of the map."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from support.messages import check_message, mentions, raises

from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.virtual.faults import load_fault_script

SCRIPT = """\
seed: 3
faults:
  - {kind: noise}
  - {kind: stuck, id: 2, at: 1.0}
  - kind: lost_status
    id: 44
"""


@pytest.fixture
def script(tmp_path: Path) -> Path:
    path = tmp_path / "faults.yaml"
    path.write_text(SCRIPT, encoding="utf-8")
    return path


def test_a_servo_that_is_not_there_is_refused_with_the_line_and_those_that_are(script: Path) -> None:
    with raises(ServoMapError, f"{script}:6: faults.2.id = 44", "1, 2, 7"):
        load_fault_script(script, (7, 1, 2))
    assert [fault.kind for fault in load_fault_script(script, (2, 44)).faults] == ["noise", "stuck", "lost_status"]
    assert len(load_fault_script(script).faults) == 3, "for anybody"


def test_a_misspelt_kind_is_told_as_such(tmp_path: Path) -> None:
    path = tmp_path / "faults.yaml"
    path.write_text("faults:\n  - {kind: stuk, id: 2}\n  - {kid: stuck, id: 2}\n", encoding="utf-8")
    with raises(ServoMapError, "'stuck'", "lost_status") as error:
        load_fault_script(path)
    first, second = str(error.value).split("; /")
    assert first.startswith(f"{path}:2: faults.0.kind: ")
    check_message(f"/{second}", f"{path}:3: faults.1.kid", "'kind'")
    path.write_text("faults: [{kind: stuck, id: 2, att: 1}]", encoding="utf-8")
    with raises(ServoMapError, "faults.0.att", "'at'"):
        load_fault_script(path)


@pytest.mark.parametrize(("kind", "largest"), [("wrong_mode", 255), ("wrong_firmware", 255), ("wrong_model", 65535)])
def test_a_value_that_its_register_cannot_hold_is_refused(kind: str, largest: int, tmp_path: Path) -> None:
    path = tmp_path / "faults.yaml"
    path.write_text(f"faults:\n  - {{kind: {kind}, id: 2, value: {largest}}}\n", encoding="utf-8")
    load_fault_script(path)
    path.write_text(f"faults:\n  - {{kind: {kind}, id: 2, value: {largest + 1}}}\n", encoding="utf-8")
    with raises(ServoMapError, f"{path}:2: faults.0.value = {largest + 1}", str(largest)):
        load_fault_script(path)


@pytest.mark.parametrize("command", ["virtual", "replay"])
def test_the_commands_refuse_it_before_anything_starts(script: Path, map_file: Path, command: str) -> None:
    from .conftest import swing

    record = script.parent / "record.h5"
    swing().save(record)
    arguments = [command, "--map", map_file, "--faults", script]
    arguments += ["--port", "virtual", record] if command == "replay" else []
    done = subprocess.run(
        [sys.executable, "-m", "dynsim", "hw", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=script.parent,
    )
    assert done.returncode == 2
    assert mentions(done.stderr, "faults.2.id = 44", "1, 2, 7")
    assert not done.stdout


def test_a_loss_of_the_supply_needs_a_time_and_has_a_length(tmp_path: Path) -> None:
    path = tmp_path / "faults.yaml"
    path.write_text("faults: [{kind: supply_loss}]", encoding="utf-8")
    with raises(ServoMapError, "faults.0.at"):
        load_fault_script(path)
    path.write_text("faults: [{kind: supply_loss, at: 1}]", encoding="utf-8")
    (fault,) = load_fault_script(path).faults
    assert fault.span == (1.0, 1.3)
