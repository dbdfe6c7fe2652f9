"""The table of what cannot be combined: each entry is refused with one error, and its neighbours are accepted."""

from __future__ import annotations

import copy
import re
from typing import Any

import pytest

import dynsim
from dynsim.engine import check
from dynsim.errors import DynsimError
from dynsim.scenario import ScenarioConfig
from dynsim.scenario.combinations import LAWS, METHODS, RESTRICTIONS, Restriction
from dynsim.scenario.reading import scenario_from_resolved

ARM: dict[str, Any] = {
    "name": "arm",
    "duration_s": 0.1,
    "plant": {"type": "serial_arm", "chain": [{"axis": "y", "length_m": 0.3, "mass_kg": 0.2}]},
    "surfaces": {"floor": {"type": "plane", "point_m": [0, 0, 0.3]}},
    "contacts": {"points": {"tip": {"body": "link_1", "point_m": [0, 0, 0.3]}}},
}
TIE = {"type": "linear", "body": "link_1", "other": "block", "axis": [0, 0, 1], "stiffness_N_per_m": 1.0}
BLOCK = {"mass_kg": 1, "size_m": [0.1, 0.1, 0.1], "position_m": [1, 0, 1]}
# What uses each feature, as overrides of the arm.
USES: dict[str, dict[str, Any]] = {
    "integrator.method: time_stepping": {},
    "smoothed slip direction": {"contacts.slip_smoothing_m_s": 0.002},
    "static, Stribeck": {"contacts.restitution": 0.2},
    "contact candidates": {"contacts.candidates": "joints"},
    "friction that depends": {"contacts.points.tip.grip": {"axis": [1, 0, 0], "ratio": 0.5}},
    "compliant": {"contacts.stiffness_N_per_m": 1e4},
    "ties": {"ties": {"spring": TIE}, "objects": {"block": BLOCK}},
    "dry friction": {"plant.chain.0.friction_N_m": 0.1},
    "a mobile base": {},
    "integrator.solver": {"integrator.solver": "m_star"},
    "integrator.theta": {"integrator.theta": 0.7},
}


def overridden(scenario: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """A scenario with values at dotted keys."""
    result = copy.deepcopy(scenario)
    for key, value in changes.items():
        node: Any = result
        *inner, last = key.split(".")
        for part in inner:
            node = node[int(part)] if isinstance(node, list) else node.setdefault(part, {})
        node[last] = value
    return result


def use(restriction: Restriction, law: str, method: str) -> dict[str, Any]:
    """The arm with the feature under a law and a method."""
    name = restriction.feature.strip("`")
    changes = next(changes for start, changes in USES.items() if name.startswith(start))
    scenario = ARM
    if name == "a mobile base":
        plant = {"type": "pws_arm", "arm": ARM["plant"]}
        scenario = {**ARM, "plant": plant, "contacts": {}, "surfaces": {}}
    return overridden(scenario, {**changes, "contacts.law": law, "integrator.method": method})


CELLS = [
    pytest.param(restriction, law, method, id=f"{restriction.feature[:24]}-{law}-{method}")
    for restriction in RESTRICTIONS
    if restriction.keys is not None or restriction.parts is not None
    for law in LAWS
    for method in METHODS
]


@pytest.mark.parametrize(("restriction", "law", "method"), CELLS)
def test_every_cell_is_accepted_or_refused_as_the_table_has_it(restriction: Restriction, law: str, method: str) -> None:
    # The glued law has no time stepping, whatever else the scenario uses.
    glued = law == "bilateral" and method == "time_stepping"
    unused = "`integrator.method: time_stepping`" in restriction.feature and method != "time_stepping"
    if unused or (law in restriction.laws and method in restriction.methods and not glued):
        assert check(scenario_from_resolved(use(restriction, law, method)))
        return
    with pytest.raises(DynsimError) as caught:
        check(scenario_from_resolved(use(restriction, law, method)))
    text = str(caught.value)
    assert "\n" not in text
    requirement = r"requires (contacts\.law|integrator\.method): .* \(here: \w+\)"
    assert re.search(requirement + ", because .*; .*, or change the (law|method)", text)


def test_restrictions_without_keys_and_parts_are_methods_of_a_simulation() -> None:
    for restriction in RESTRICTIONS:
        if restriction.keys is None and restriction.parts is None:
            assert hasattr(dynsim.Simulation, restriction.feature.strip("`").removeprefix("Simulation."))


def test_a_plain_scenario_uses_no_restricted_feature() -> None:
    config = ScenarioConfig.model_validate(ARM)
    for restriction in RESTRICTIONS:
        assert restriction.keys is None or not list(restriction.keys(config))
