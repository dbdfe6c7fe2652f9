"""The table of what cannot be combined: each entry is refused with one error, and its neighbours are accepted."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from support.messages import raises

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
# What uses each feature of the table, in its order, as overrides of the arm.
USES: list[dict[str, Any]] = [
    {},
    {"contacts.slip_smoothing_m_s": 0.002},
    {"contacts.restitution": 0.2},
    {"contacts.candidates": "joints"},
    {
        "contacts.between": [{"bodies": ["link_1", "block"]}],
        "objects": {"block": BLOCK},
        "plant.chain.0.radius_m": 0.02,
    },
    {"contacts.points.tip.grip": {"axis": [1, 0, 0], "ratio": 0.5}},
    {"contacts.stiffness_N_per_m": 1e4},
    {"ties": {"spring": TIE}, "objects": {"block": BLOCK}},
    {"plant.chain.0.friction_N_m": 0.1},
    {"plant": {"type": "pws_arm", "arm": ARM["plant"]}, "contacts": {}, "surfaces": {}},
    {"integrator.solver": "m_star"},
    {"integrator.theta": 0.7},
]


def overridden(scenario: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """A scenario with values at dotted keys."""
    result = copy.deepcopy(scenario)
    for key, value in changes.items():
        node: Any = result
        *inner, last = key.split(".")
        for part in inner:
            node = node[int(part)] if isinstance(node, list) else node.setdefault(part, {})
        node[last] = copy.deepcopy(value)
    return result


def use(changes: dict[str, Any], law: str, method: str) -> dict[str, Any]:
    """The arm with the feature under a law and a method."""
    return overridden(ARM, {**changes, "contacts.law": law, "integrator.method": method})


USED = [restriction for restriction in RESTRICTIONS if restriction.keys is not None or restriction.parts is not None]
CELLS = [
    pytest.param(restriction, changes, law, method, id=f"{restriction.feature[:24]}-{law}-{method}")
    for restriction, changes in zip(USED, USES, strict=True)
    for law in LAWS
    for method in METHODS
]


@pytest.mark.parametrize(("restriction", "changes", "law", "method"), CELLS)
def test_every_cell_is_accepted_or_refused_as_the_table_has_it(
    restriction: Restriction, changes: dict[str, Any], law: str, method: str
) -> None:
    # The glued law has no time stepping, whatever else the scenario uses.
    glued = law == "bilateral" and method == "time_stepping"
    unused = not changes and method != "time_stepping"
    if unused or (law in restriction.laws and method in restriction.methods and not glued):
        assert check(scenario_from_resolved(use(changes, law, method)))
        return
    broken = RESTRICTIONS[0] if glued else restriction
    required = (
        f"contacts.law: {broken.laws[0]}" if law not in broken.laws else f"integrator.method: {broken.methods[0]}"
    )
    with raises(DynsimError, required, law if law not in broken.laws else method, broken.reason, broken.fix) as caught:
        check(scenario_from_resolved(use(changes, law, method)))
    assert "\n" not in str(caught.value)


def test_restrictions_without_keys_and_parts_are_methods_of_a_simulation() -> None:
    for restriction in RESTRICTIONS:
        if restriction.keys is None and restriction.parts is None:
            assert hasattr(dynsim.Simulation, restriction.feature.strip("`").removeprefix("Simulation."))


def test_a_plain_scenario_uses_no_restricted_feature() -> None:
    config = ScenarioConfig.model_validate(ARM)
    for restriction in RESTRICTIONS:
        assert restriction.keys is None or not list(restriction.keys(config))
