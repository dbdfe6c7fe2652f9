"""``integrator.method: auto``: the fastest rate of a system at its start, and the chosen method."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from support.messages import check_message

from dynsim import Scenario, load_scenario, simulate
from dynsim.dynamics.derivative import derivative
from dynsim.dynamics.state import block
from dynsim.engine.prepare import fastest_rate, prepare
from dynsim.scenario import scenario_from_resolved


def chosen(scenario: Scenario) -> str:
    return prepare(scenario, end=0.01, times=np.array([0.0])).choice.method


def shipped(name: str, variant: str | None = None, **changes: Any) -> Scenario:
    return load_scenario(name, variant, {"duration_s": 0.01, "integrator.method": "auto", **changes})


def chain(links: int = 2, **more: Any) -> Scenario:
    link = {"axis": "y", "length_m": 0.5, "radius_m": 0.01, "mass_kg": 1.0, "initial_deg": 30}
    joint = more.pop("joint", {})
    more["integrator"] = {"method": "auto", **more.get("integrator", {})}
    plant = {"type": "serial_arm", "chain": [link | joint for _ in range(links)]}
    return scenario_from_resolved({"name": "chain", "duration_s": 0.01, "plant": plant, **more})


@pytest.mark.parametrize("variant", ["no_elbow", "elbow_7", "two_elbows"])
def test_the_fastest_rate_is_that_of_the_right_hand_side(variant: str) -> None:
    """Differences of the kernels' derivative, with gravity in it, which is slow."""
    prepared = prepare(shipped("elbow_comparison", variant, **{"contacts.friction": 0.0}))
    system, y = prepared.system, prepared.run.y.copy()
    places = [k for name in ("q", "v", "current") for k in range(len(y))[block(system.layout, name)]]
    low, high = np.zeros(len(y)), np.zeros(len(y))
    columns = []
    for k in places:
        h = 1e-6
        y[k] += h
        derivative(system, 0.0, y, prepared.workspace, high)
        y[k] -= 2 * h
        derivative(system, 0.0, y, prepared.workspace, low)
        y[k] += h
        columns.append((high - low)[places] / (2 * h))
    rate = np.abs(np.linalg.eigvals(np.array(columns).T)).max()
    estimate = fastest_rate(prepared.model, prepared.contacts, prepared.system.drives)
    assert estimate == pytest.approx(rate, rel=0.003)


def test_motors_are_integrated_implicitly_and_the_summary_says_why() -> None:
    record = simulate(shipped("elbow_comparison", "two_elbows"))
    assert record.summary["method"] == "radau5"
    check_message(record.summary["method_reason"], "1.93e+03 1/s", "20 ms")


def test_what_is_named_is_taken() -> None:
    for method in ("dopri5", "radau5"):
        assert chosen(shipped("elbow_comparison", "no_elbow", **{"integrator.method": method})) == method


@pytest.mark.parametrize(("rtol", "within"), [(1e-6, 1.0), (1e-8, 5.0), (1e-10, 5.0)])
@pytest.mark.parametrize("links", [1, 2, 6])
def test_passive_systems_keep_their_energy(links: int, rtol: float, within: float) -> None:
    """Chains that tumble for 10 s. At the tolerance itself they are off by up to 34 rtol."""
    record = simulate(chain(links, joint={"initial_deg": 120}, integrator={"rtol": rtol}, duration_s=10))
    assert record.summary["method"] == "dopri5"
    check_message(record.summary["method_reason"])
    assert "1/s" not in record.summary["method_reason"]
    assert record.summary["energy_residual_relative"] <= within * rtol


def test_steps_of_passive_systems_shrink_with_the_tolerance() -> None:
    tolerances = [10.0**exponent for exponent in np.arange(-3.0, -13.1, -0.25)]
    prepared = [prepare(chain(integrator={"rtol": rtol}), end=0.01, times=np.array([0.0])) for rtol in tolerances]
    taken = [run.choice.sharper * rtol for run, rtol in zip(prepared, tolerances, strict=True)]
    above = [x for x, rtol in zip(taken, tolerances, strict=True) if rtol > 1e-11]
    assert all(later <= earlier for earlier, later in pairwise(above))


def test_passive_systems_whose_contacts_rub_are_integrated_implicitly_up_to_36_joints() -> None:
    """A Jacobian of longer chains costs more than what it would save."""
    surfaces = {"floor": {"type": "plane", "point_m": [0.0, 0.0, -50.0]}}
    touching = {"law": "unilateral", "points": {"tip": {"body": "link_1", "surface": "floor"}}}
    for friction, links, method in ((0.3, 2, "radau5"), (0.0, 2, "dopri5"), (0.3, 37, "dopri5")):
        assert chosen(chain(links, surfaces=surfaces, contacts=touching | {"friction": friction})) == method


def test_slow_losses_are_integrated_explicitly() -> None:
    assert chosen(chain(joint={"damping_N_m_s_per_rad": 0.1})) == "dopri5"


def test_fast_losses_without_motors_are_integrated_implicitly() -> None:
    assert chosen(chain(joint={"damping_N_m_s_per_rad": 500.0})) == "radau5"


def test_short_steps_of_a_sampled_controller_or_a_limit_are_for_explicit_methods() -> None:
    assert chosen(shipped("elbow_comparison", "no_elbow", **{"integrator.step_max_s": 1e-3})) == "dopri5"
    assert chosen(shipped("elbow_comparison", "no_elbow", **{"controller.sample_time_s": 1e-3})) == "dopri5"


def test_the_largest_rate_of_a_long_chain_is_found_without_all_others() -> None:
    prepared = prepare(chain(links=160, joint={"damping_N_m_s_per_rad": 0.5, "length_m": 0.02}))
    mobility = np.linalg.inv(prepared.model.mass_matrix(prepared.model.robot.initial))
    rate = np.linalg.eigvalsh(0.5 * mobility).max()
    assert fastest_rate(prepared.model, [], prepared.system.drives) == pytest.approx(rate, rel=0.02)
