"""Names, symbols and units of scenario keys and of numbers in summaries."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest

import dynsim
from dynsim.record.quantities import Quantity, summary_quantity, unit_of
from dynsim.scenario import shipped_scenarios, variant_names
from dynsim.scenario.quantities import quantity

ARM = {
    "duration_s": 1.0,
    "plant": {
        "type": "serial_arm",
        "chain": [{"count": 3}, {"initial_deg": 20.0, "motor": {"type": "dc"} | {
            "torque_constant_N_m_per_A": 0.2, "resistance_ohm": 1.0, "inductance_H": 0.001, "mass_kg": 0.3,
            "rotor_inertia_kg_m2": 1e-4, "gear_ratio": 3.0, "gear_damping_N_m_s_per_rad": 0.01,
        }}],
    },
    "surfaces": {
        "table": {"type": "box", "center_m": [0.5, 0.0, 0.2], "edges_m": [1.0, 1.0, 0.1]},
        "floor": {"type": "plane"},
        "pipe": {"type": "cylinder", "point_m": [0.0, 0.0, 1.0], "axis": [1.0, 0.0, 0.0], "radius_m": 0.1},
    },
    "contacts": {"law": "unilateral", "points": {"elbow": {"body": "link_2", "surface": "floor", "friction": 0.4}}},
    "loads": {"tool": {"type": "payload", "body": "link_4", "mass_kg": 0.2}},
}  # fmt: skip


@pytest.mark.parametrize(
    ("key", "label", "symbol"),
    [
        ("duration_s", "simulated time [s]", ""),
        ("surfaces.table.center_m.2", "height of table's centre [m]", ""),
        ("surfaces.pipe.point_m.2", "height of pipe's axis [m]", ""),
        ("surfaces.table.center_m.0", "centre of table, x [m]", ""),
        ("surfaces.floor.point_m.2", "height of floor [m]", ""),
        # The first entry of the chain has three joints.
        ("plant.chain.1.initial_deg", "initial angle of joint 4 [°]", ""),
        ("plant.chain.0.mass_kg", "mass of links 1 to 3 [kg]", ""),
        ("plant.chain.*.mass_kg", "mass of all links [kg]", ""),
        ("plant.chain.1.motor.gear_damping_N_m_s_per_rad", "gear damping of joint 4 [N m s/rad]", ""),
        ("plant.chain.1.motor.mass_kg", "motor mass of joint 4 [kg]", ""),
        ("plant.gravity_m_s2.2", "gravitational acceleration, z [m/s²]", ""),
        ("contacts.friction", "coefficient of friction", "μ"),
        ("contacts.points.elbow.friction", "coefficient of friction of elbow", "μ"),
        ("contacts.points.elbow.point_m.2", "position of elbow, z [m]", ""),
        ("loads.tool.mass_kg", "mass of tool [kg]", ""),
        ("integrator.rtol", "relative tolerance", ""),
    ],
)
def test_key_has_name_symbol_and_unit(key: str, label: str, symbol: str) -> None:
    scenario = dynsim.Scenario("arm", "", dynsim.scenario.ScenarioConfig.model_validate(ARM))
    described = quantity(key, scenario)
    assert (described.label, described.symbol) == (label, symbol)
    assert quantity(key, scenario.config) == described


def test_key_without_scenario_is_named_by_its_words() -> None:
    labels = [
        quantity(key).label for key in ("surfaces.table.center_m.2", "loads.tool.mass_kg", "plant.k.stall_time_s")
    ]
    assert labels == ["height of table's centre [m]", "mass of tool [kg]", "stall time of the k [s]"]


def test_every_key_of_shipped_scenarios_is_readable() -> None:
    """Names have no underscores, except names from the scenario itself; units agree with the keys."""
    for path in shipped_scenarios():
        scenario = dynsim.load_scenario(path, next(iter(variant_names(path)), None))
        for key in numeric_keys(scenario.config.model_dump(), ()):
            described = quantity(key, scenario)
            own = " ".join(part for part in key.split(".") if f" {part}" in described.name)
            assert 0 < len(described.name) <= 80, (key, described)
            assert "_" not in "".join(word for word in described.name.split() if word.strip(",") not in own), key
            unit = next((unit for part in reversed(key.split(".")) if (unit := unit_of(part)[1])), "")
            assert not unit or described.unit == unit, (key, described)


@pytest.mark.parametrize(
    "key", ["mass_kg", "point_m.2", "plant.chain.x.mass_kg", "plant.chain.99.mass_kg", "plant.chain.0", "", "..", "*.*"]
)
def test_unknown_keys_have_quantities_too(key: str) -> None:
    config = dynsim.scenario.ScenarioConfig.model_validate(ARM)
    assert isinstance(quantity(key, config), Quantity)
    assert isinstance(quantity(key), Quantity)
    assert isinstance(summary_quantity(key), Quantity)


def numeric_keys(value: Any, path: tuple[str, ...]) -> Iterator[str]:
    """All dotted keys of numbers in plain values."""
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from numeric_keys(entry, (*path, str(key)))
    elif isinstance(value, list):
        for k, entry in enumerate(value):
            yield from numeric_keys(entry, (*path, str(k)))
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield ".".join(path)


@pytest.mark.parametrize(
    ("key", "label"),
    [
        ("electrical_energy_J", "electrical energy [J]"),
        ("electrical_energy_drawn_J", "energy, separate supplies [J]"),
        ("hand_error_z_rms_m", "hand error, vertical, rms [mm]"),
        ("final_position_error_m", "final position error [m]"),
        ("joint_rate_max_rad_s", "joint rate, max [rad/s]"),
        ("battery_energy_Wh", "battery energy [Wh]"),
        ("base.tip_margin_min", "tip margin, whole run"),
        ("base.wheel_load_min_N.left", "left: wheel load, min [N]"),
        ("elbow_c.normal_force_max_N", "elbow_c: normal force, max [N]"),
        ("joint_4.torque_rms_N_m", "joint_4: torque, rms [N m]"),
        ("support_area_final_m2", "support area, final [m²]"),
    ],
)
def test_number_of_summary_has_name_and_unit(key: str, label: str) -> None:
    assert summary_quantity(key).label == label


@pytest.mark.parametrize(
    ("values", "unit", "scale"),
    [
        ([0.01, -0.09], "mm", 1e3),
        ([0.01, 0.1], "m", 1.0),
        ([0.0], "m", 1.0),
        ([1e-9], "m", 1.0),
        ([None, 0.02], "mm", 1e3),
        ([], "m", 1.0),
    ],
)
def test_small_lengths_are_in_millimetres(values: list[float | None], unit: str, scale: float) -> None:
    fitted = Quantity("gap", unit="m").fitted(values)
    assert (fitted.unit, fitted.scale) == (unit, scale)
    assert Quantity("mass", unit="kg").fitted(values).unit == "kg"


def test_unit_of_every_key_suffix_is_printed_as_a_fraction() -> None:
    units = {
        key: unit_of(key)[1] for key in ("a_N_s_per_m", "a_V_s_per_rad", "a_per_s", "a_m_s2", "a_kg_m2", "a_rad_s")
    }
    assert list(units.values()) == ["N s/m", "V s/rad", "1/s", "m/s²", "kg m²", "rad/s"]
    assert not any(re.search(r"_|per", unit) for unit in units.values())
