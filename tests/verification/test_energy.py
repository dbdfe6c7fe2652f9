"""Net, supply and drawn electrical energy, and the residual of the ledger at rest and in free motion."""

import numpy as np
import pytest
from studies.validation import FREE, free_scenario
from support.messages import lines_with

import dynsim
from dynsim.engine import recording as metrics
from dynsim.scenario import build, scenario_from_resolved

MOTOR = {
    "type": "dc", "torque_constant_N_m_per_A": 0.2, "resistance_ohm": 0.1, "inductance_H": 0.001,
    "rotor_inertia_kg_m2": 1e-5, "gear_ratio": 20,
}  # fmt: skip
LOWERED = {"times_s": [0, 1], "angles_deg": [90, 170]}


def arm(paths: list[dict]) -> dynsim.Record:
    """One rod of 2 kg, or two in a row, lowered by motors that brake and return electrical energy."""
    chain = [{"axis": "y", "mass_kg": 2.0, "length_m": 1.0, "motor": MOTOR, "initial_deg": 90}]
    if len(paths) == 2:
        chain.append({**chain[0], "initial_deg": 0})
    return dynsim.simulate(
        scenario_from_resolved(
            {
                "name": "lift",
                "duration_s": 1.5,
                "plant": {"type": "serial_arm", "chain": chain},
                "controller": {
                    "type": "joint_pd",
                    "joints": {f"joint_{k + 1}": path for k, path in enumerate(paths)},
                },
                "record": {"rate_hz": 5000},
            }
        )
    )


@pytest.mark.parametrize("paths", [[LOWERED], [LOWERED, {"times_s": [0, 1], "angles_deg": [0, -120]}]])
def test_energies_of_the_three_supplies(paths):
    record = arm(paths)
    power = record["power"]
    net, supply, drawn = (record[f"energy_electrical{kind}"] for kind in ("", "_supply", "_drawn"))
    # Samples summed by trapezia: with kinks where a power changes its sign, and a start that takes 10 ms.
    for integral, rate in (
        (net, power.sum(axis=1)),
        (supply, np.maximum(power.sum(axis=1), 0.0)),
        (drawn, np.maximum(power, 0.0).sum(axis=1)),
    ):
        assert integral[-1] == pytest.approx(np.trapezoid(rate, record.time), rel=2e-3)
    assert net[-1] < supply[-1] - 0.1
    if len(paths) == 1:
        np.testing.assert_array_equal(supply, drawn)
    else:
        assert supply[-1] < drawn[-1] - 0.1
    summary = record.summary
    assert (summary["electrical_energy_supply_J"], summary["electrical_energy_drawn_J"]) == (supply[-1], drawn[-1])


def still(chain, **more) -> dynsim.Record:
    return dynsim.simulate(
        scenario_from_resolved(
            {"name": "still", "duration_s": 2, "plant": {"type": "serial_arm", "chain": chain}, **more}
        )
    )


def test_hanging_at_rest_has_no_residual_to_speak_of():
    """The turnover is some 1e-28 J of rounding; the floor is rtol times m g l/2 = 1.5 J."""
    record = still([{"axis": "y", "length_m": 1.0, "mass_kg": 0.3, "initial_deg": 180}])
    assert record.summary["energy_turnover_J"] < 1e-12
    assert record.summary["energy_residual_relative"] < 1e-9
    assert record.summary["warnings"] == []


def test_an_immobile_arm_has_no_residual_to_speak_of():
    """Two links with both ends held: what is left is rounding and what drift lets through."""
    record = still(
        [{"axis": "y", "initial_deg": 60}, {"axis": "y", "initial_deg": 60}],
        surfaces={
            "floor": {"type": "plane"},
            "wall": {"type": "plane", "point_m": [0.6 * np.sin(np.pi / 3), 0, 0], "normal": [-1, 0, 0]},
        },
        contacts={"friction": 0.0, "points": {
            "foot": {"body": "link_2", "point_m": [0, 0, 0.3]},
            "side": {"body": "link_2", "point_m": [0, 0, 0.3], "surface": "wall"},
        }},
    )  # fmt: skip
    assert record.summary["energy_turnover_J"] < 1e-9
    assert record.summary["energy_residual_relative"] < 1e-6
    assert not lines_with(record.summary["warnings"], phrase="ledger")


def test_the_floor_is_far_below_what_a_run_turns_over():
    scenario = dynsim.load_scenario("elbow_comparison", overrides={"duration_s": 1})
    record = dynsim.simulate(scenario)
    floor = metrics.residual_floor(record, build.robot(scenario), 1e-6)
    # Weights of 0.1 kg along 2.7 m, at the middles of nine links: 0.981 N · Σ (k − ½) 0.3 m = 11.9 J.
    assert floor == pytest.approx(1e-6 * 0.981 * 0.3 * 40.5)
    summary = record.summary
    assert summary["energy_residual_relative"] == np.abs(record["energy_residual"]).max() / summary["energy_turnover_J"]


@pytest.mark.parametrize("name", sorted(FREE))
def test_free_motion_leaves_no_more_than_is_documented(name):
    """Compare with docs/validation/evidence.md: tens of rtol without losses, a warning above 1e-6, and rtol helps."""
    summary = dynsim.simulate(free_scenario(name)).summary
    assert summary["energy_residual_relative"] < 2e-4
    warned = bool(lines_with(summary["warnings"], phrase="ledger"))
    assert warned == (summary["energy_residual_relative"] > metrics.RESIDUAL_LIMIT)
