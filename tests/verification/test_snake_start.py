"""Start of the dynamic snake: its preliminary run has the ground and payloads; t = 0 is checked as any start."""

import numpy as np
import pytest
from support.messages import raises

from dynsim.engine import check, simulate
from dynsim.errors import ModelError
from dynsim.scenario import load_scenario

# Tip of the gripper in the axes of the head's body [m].
TIP = [0.1805, 0.0, 0.0]


def dynamic(**overrides):
    changes = {"plant.level": "dynamic", "duration_s": 0.05, "controller.paths": [], **overrides}
    return load_scenario("snake_positioning_dynamic", "x", changes)


def plate(x):
    """A plate that the head point touches at x [m]; the gripper ahead of it does not count."""
    return {
        "contacts.candidates": "points",
        "surfaces": {"plate": {"type": "plane", "point_m": [float(x), 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}},
        "contacts.points": {
            "plate": {
                "body": "head",
                "point_m": [0.0905, 0.0, 0.0],
                "surface": "plate",
                "friction": 0.0,
                "stiffness_N_per_m": 3e4,
                "damping_N_s_per_m": 50.0,
            }
        },
    }


def ties():
    """A gripper: six ties between a load and the tip."""
    linear = {"type": "linear", "body": "load", "other": "head", "other_point_m": TIP}
    linear |= {"stiffness_N_per_m": 5000.0, "damping_N_s_per_m": 20.0, "bound_N": 20.0}
    torsion = {"type": "torsion", "body": "load", "other": "head"}
    torsion |= {"stiffness_N_m_per_rad": 5.0, "damping_N_m_s_per_rad": 0.05, "bound_N_m": 0.8}
    axes = dict(zip("xyz", np.eye(3).tolist(), strict=True))
    return {
        f"{kind}_{name}": tie | {"axis": axis}
        for kind, tie in (("force", linear), ("moment", torsion))
        for name, axis in axes.items()
    }


@pytest.fixture(scope="module")
def alone():
    return simulate(dynamic())


def test_a_plate_ahead_of_the_head_leaves_the_start_alone(alone):
    """The lowered head reaches through the plate, whose spring would push the robot back before t = 0."""
    record = simulate(dynamic(**plate(alone["w"][0, 0] + 0.001)))
    np.testing.assert_array_equal(record["q"][0], alone["q"][0])
    gap = record["contact_gap"][0, record.labels["contact_gap"].index("plate")]
    assert gap == pytest.approx(0.001, abs=1e-12)


def test_a_tied_object_starts_where_it_is_placed(alone):
    """Its ties begin at t = 0, at rest as the head is then; before that they would drag it along."""
    position = [0.3, 0.0, 0.03]
    box = {"mass_kg": 0.2, "size_m": [0.06, 0.06, 0.06], "position_m": position}
    record = simulate(dynamic(objects={"load": box}, ties=ties()))
    own = alone["q"].shape[1]
    np.testing.assert_array_equal(record["q"][0, :own], alone["q"][0])
    columns = [record.labels["q"].index(f"load.{axis}") for axis in "xyz"]
    np.testing.assert_array_equal(record["q"][0, columns], position)
    # These are the forces of the first step. The ties are at rest at t = 0, and the load begins to fall.
    assert np.abs(record["tie_force"][0]).max() < 0.5


def test_a_start_within_a_plate_is_refused_as_any_other(alone):
    """20 mm deep; a compliant point may start 5 mm deep."""
    scenario = dynamic(**plate(alone["w"][0, 0] - 0.02))
    for start in (simulate, lambda scenario: check(scenario, lambda _: None)):
        with raises(ModelError, "contacts.points.plate", "-0.02 m", "'plate'"):
            start(scenario)


def test_payloads_are_part_of_the_preliminary_run(alone):
    """0.2 kg on the head lower it further."""
    heavy = simulate(dynamic(loads={"tool": {"type": "payload", "body": "head", "mass_kg": 0.2}}))
    assert heavy["w"][0, 2] < alone["w"][0, 2] - 1e-3


def test_modes_that_lift_pair_1_are_refused():
    """The pair stays on the ground, because nothing raises it, while the controller moves as if it was in the air."""
    with raises(ModelError, "controller.modes", "7, 8, 9", "1", "plant.level"):
        simulate(load_scenario("snake_circle_backward", None, {"plant.level": "dynamic"}))
