"""A small rig for the hardware tests: two MX-106 joints and one MX-28 wheel on a virtual line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from studies.fault_table import GOAL_ADDRESSES, MAP, TORQUE_ADDRESS, Rig, Run, goals_in, swing

from dynsim.hardware.replay.check import velocity_limit
from dynsim.hardware.servo_map import load_servo_map

__all__ = ["GOAL_ADDRESSES", "MAP", "TORQUE_ADDRESS", "Rig", "Run", "goals_in", "swing"]


def check_goals_within_limits(run: Run) -> None:
    limits = {servo.id: servo.tick_limits for servo in run.map.servos if servo.in_position_mode}
    fastest = {
        servo.id: abs(servo.to_velocity_units(velocity_limit(servo)))
        for servo in run.map.servos
        if not servo.in_position_mode
    }
    for _, id_, value in run.goals():
        if id_ in limits:
            assert limits[id_][0] <= value <= limits[id_][1]
        else:
            assert abs(value) <= fastest[id_]


@pytest.fixture(scope="session")
def map_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    path.write_text(MAP, encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def rig(map_file: Path) -> Rig:
    return Rig(load_servo_map(map_file))


@pytest.fixture(scope="session")
def clean_run(rig: Rig) -> Run:
    """A replay without faults, for those who only look at it."""
    return rig.run()


@pytest.fixture
def write_map(tmp_path: Path) -> Callable[..., Path]:
    """Write the rig's map with replacements: write_map(("a", "b"), …)."""

    def write(*replacements: tuple[str, str]) -> Path:
        text = MAP
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "map.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return write
