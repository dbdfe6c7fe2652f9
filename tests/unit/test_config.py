"""Numbers in scenarios and servo maps: strings and booleans are refused, numbers of numpy are accepted."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.messages import raises

from dynsim.errors import ScenarioError
from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.servo_map import SHIPPED, load_servo_map
from dynsim.scenario import load_scenario


@pytest.mark.parametrize("value", [True, False, "1_9.2", "0.1", "１"])
@pytest.mark.parametrize(
    "key", ["plant.link.mass_kg", "controller.hand.path.center_m.0", "plant.initial_deg.3", "plant.chain.1.count"]
)
def test_a_scenario_takes_neither_texts_nor_flags_for_numbers(key: str, value: Any) -> None:
    with raises(ScenarioError, f"{key} = {value!r}"):
        load_scenario("elbow_comparison", overrides={key: value})


def test_numbers_of_numpy_are_numbers() -> None:
    overrides = {"plant.link.mass_kg": np.float32(0.5), "plant.chain.1.count": np.int64(9), "plant.link.radius_m": 1}
    plant = load_scenario("elbow_comparison", overrides=overrides).plant
    assert [plant.chain[1].mass_kg, plant.chain[1].count, plant.chain[1].radius_m] == [0.5, 9, 1.0]


def test_numbers_that_are_keys_are_read_from_text() -> None:
    assert load_scenario("snake_circle_backward").controller.modes[7] == [1, 2]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("torque: 6.0", "torque: true"),
        ("id: 4,", 'id: "4",'),
        ("id: 1,", "id: true,"),
        ("velocity: 4.0", 'velocity: "1_9"'),
    ],
)
def test_a_servo_map_takes_neither_texts_nor_flags_for_numbers(old: str, new: str, tmp_path: Path) -> None:
    text = (SHIPPED / "arm.yaml").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "map.yaml").write_text(text.replace(old, new, 1), encoding="utf-8")
    with raises(ServoMapError, re.compile(rf"map\.yaml:\d+: \S+\.{new.partition(':')[0]} = ")):
        load_servo_map(tmp_path / "map.yaml")
