"""Servo maps accept every model with a control table, and replays use the units of that model."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from dynsim.hardware.bus.control_table import HEALTH_BLOCK, MODELS, STATE_BLOCK
from dynsim.hardware.servo_map import Kind, load_servo_map

from .conftest import Rig


def test_maps_name_every_model_that_there_is_a_table_of() -> None:
    assert set(get_args(Kind.model_fields["model"].annotation)) == set(MODELS)


@pytest.mark.parametrize("name", MODELS)
def test_what_the_loop_reads_stands_in_the_same_place_on_all_models(name: str) -> None:
    fields = MODELS[name].fields
    effort = fields["present_current" if MODELS[name].measures_current else "present_load"]
    assert (effort.address, effort.size) == (STATE_BLOCK[0], 2)
    assert fields["present_velocity"].address == STATE_BLOCK[0] + 2
    assert fields["present_position"].address + 4 == sum(STATE_BLOCK)
    assert fields["torque_enable"].address == HEALTH_BLOCK[0]
    assert fields["present_temperature"].address + 1 == sum(HEALTH_BLOCK)


FIVE_VOLTS = (
    ("model: MX-28", "model: XL330-M288"),
    ("torque: 1.8", "torque: 0.15"),
    ("{lowest: 10.5, highest: 14.0}", "{lowest: 4.4, highest: 5.8}"),
)
"""Changes of the rig for servos that need a supply of 5 V."""


@pytest.mark.parametrize("name", [name for name in MODELS if not name.startswith("MX")])
def test_a_replay_on_servos_of_another_model(name: str, write_map: Callable[..., Path]) -> None:
    """The joints lag by d/k of their model's law, and the torque told is the torque that moved them."""
    stall = MODELS[name].stall_torque
    servo_map = load_servo_map(
        write_map(
            ("model: MX-106", f"model: {name}"),
            ("velocity: 3.0, torque: 6.0", f"velocity: 3.0, torque: {0.7 * stall}"),
            *(FIVE_VOLTS if name.startswith("XL330") else ()),
        )
    )
    run = Rig(servo_map).run()
    assert run.result.fault is None
    assert run.result.end_state == "off"
    record = run.result.record
    lag = (41.0 / 8.4) ** -1 / MODELS[name].no_load_speed  # k per stall torque is that of the MX-106
    moving = slice(20, -20)
    expected = lag * record["v"][moving]
    error = (record["q_goal"] - record["q"])[moving]
    # One cycle between goal and reading, ticks, and the inertia's own lag at 4 rad/s.
    assert np.abs(error - expected).max() < 0.02 * np.abs(record["v"]).max()
    assert 0 < np.abs(record["torque_estimate"][:, :2]).max() < stall
