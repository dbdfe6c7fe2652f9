"""Objects beside a robot: bodies of their own trees, that rest, slide, turn on hinges, and are named in errors."""

import numpy as np
import pytest

import dynsim
from dynsim.errors import ModelError, ScenarioError
from dynsim.scenario import Scenario, ScenarioConfig, build

G = 9.81
ARM = {
    "type": "serial_arm",
    "link": {"mass_kg": 0.5, "length_m": 0.3},
    "chain": [{"axis": "y"}],
    "initial_deg": [180],
}


def scene(objects, duration=0.5, **changes):
    config = {
        "name": "scene",
        "duration_s": duration,
        "plant": ARM,
        "surfaces": {"floor": {"type": "plane", "point_m": [0, 0, -1.0]}},
        "contacts": {"law": "unilateral", "friction": 0.3},
        "integrator": {"method": "time_stepping", "step_s": 0.001},
        "objects": objects,
    }
    return Scenario("scene", "", ScenarioConfig.model_validate(config | changes))


# A point with a radius, far above the floor: with it, bodies with corners use the same compiled kernels as the snake.
WITH_A_TIP = {"law": "unilateral", "friction": 0.3, "points": {"tip": {"body": "link_1", "radius_m": 0.01}}}
BOX = {"mass_kg": 0.3, "size_m": [0.06, 0.08, 0.1], "position_m": [1.0, 0.0, -0.95]}


def test_a_box_at_rest_presses_with_its_weight_and_stays():
    record = dynsim.simulate(scene({"box": BOX}, contacts=WITH_A_TIP))
    assert record["contact_normal_force"][-1].sum() == pytest.approx(0.3 * G, rel=1e-9)
    columns = [record.labels["q"].index(f"box.{axis}") for axis in "xyz"]
    np.testing.assert_allclose(record["q"][-1, columns], BOX["position_m"], atol=1e-9)


def test_a_box_that_is_pulled_slides_as_a_block_does():
    """a = F/m − μ g, from rest."""
    pull = {"type": "constant", "body": "box", "force_N": [1.5, 0.0, 0.0]}
    box = BOX | {"size_m": [0.2, 0.2, 0.02], "position_m": [1, 0, -0.99]}
    record = dynsim.simulate(scene({"box": box}, loads={"pull": pull}, contacts=WITH_A_TIP))
    distance = record["q"][-1, record.labels["q"].index("box.x")] - 1.0
    assert distance == pytest.approx(0.5 * (1.5 / 0.3 - 0.3 * G) * 0.5**2, rel=2e-3)


@pytest.mark.parametrize("torque", [0.4, 0.9])
def test_a_valve_turns_where_the_torque_is_more_than_its_friction(torque):
    """(τ − τ_c)/I, I = 2 m r²/5; below τ_c it does not move at all."""
    valve = {"mass_kg": 2.0, "shape": "sphere", "radius_m": 0.1, "position_m": [0.5, 0.0, 0.4]}
    valve["hinge"] = {"axis": [1.0, 0.0, 0.0], "friction_N_m": 0.5}
    turn = {"type": "constant", "body": "valve", "torque_N_m": [torque, 0.0, 0.0]}
    record = dynsim.simulate(scene({"valve": valve}, duration=0.2, loads={"turn": turn}))
    angle = record["q"][-1, record.labels["q"].index("valve")]
    inertia = 0.4 * 2.0 * 0.1**2
    assert angle == pytest.approx(max(torque - 0.5, 0.0) / inertia * 0.5 * 0.2**2, rel=1e-6, abs=1e-12)


def test_the_arm_beside_an_object_moves_as_it_does_alone():
    """Trees that do not touch know nothing of each other."""
    alone = dynsim.simulate(scene({}, plant=ARM | {"initial_deg": [100]}))
    beside = dynsim.simulate(scene({"box": BOX}, plant=ARM | {"initial_deg": [100]}))
    np.testing.assert_allclose(beside["q"][:, 0], alone["q"][:, 0], atol=1e-12)
    np.testing.assert_allclose(beside["hand_position"], alone["hand_position"], atol=1e-12)


def test_a_box_beside_a_snake():
    scenario = dynsim.load_scenario(
        "snake_positioning",
        "x",
        {
            "plant.level": "dynamic",
            "duration_s": 0.2,
            "objects": {"box": {"mass_kg": 0.3, "size_m": [0.06, 0.06, 0.06], "position_m": [0.6, 0.0, 0.0299]}},
        },
    )
    robot = build.robot(scenario)
    assert [link.name for link in robot.links][-1] == "box"
    record = dynsim.simulate(scenario)
    assert record.scene is not None
    assert "box" in [body.name for body in record.scene.bodies]
    assert record["contact_normal_force"][-1].sum() == pytest.approx((10.0 + 0.3) * G, rel=5e-3)


def test_names_and_sizes_are_checked():
    with pytest.raises(ModelError, match=r"objects.link_1: the robot has a body, joint or frame of that name"):
        dynsim.simulate(scene({"link_1": BOX}))
    for name in ("", "world"):
        with pytest.raises(ModelError, match=f"{name!r} cannot be the name of an object"):
            dynsim.simulate(scene({name: BOX}))
    for change, says in (({"radius_m": 0.1}, "radius_m"), ({"size_m": None}, "size_m"), ({"mass_kg": 0.0}, "mass_kg")):
        with pytest.raises((ScenarioError, ValueError), match=says):
            scene({"box": BOX | change})
    assert "objects" not in scene({}).resolved
