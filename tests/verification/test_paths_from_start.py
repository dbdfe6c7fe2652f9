"""Hand paths relative to the start: position and orientation, for all kinds of paths, postures, plants and commands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from studies.planner_scenes import scene
from support.messages import raises
from support.turned_tool import TURNED

import dynsim
from dynsim.compile.hand_posture import hand_turn
from dynsim.errors import ScenarioError, UnreachableReference
from dynsim.planner import planned_scenario
from dynsim.planner.problem import Options, task
from dynsim.scenario import build
from dynsim.scenario.reading import scenario_from_resolved

OFFSETS = [[0.0, 0.0, 0.0], [-0.03, 0.02, 0.01], [-0.05, 0.0, 0.04]]
ARM = {
    "type": "serial_arm",
    "link": {"mass_kg": 0.2, "length_m": 0.4, "damping_N_m_s_per_rad": 0.3, "motor": {"type": "wang_minami"}},
    "chain": [{"axis": "z", "length_m": 0.0}, {"axis": "y", "count": 4}],
    "initial_deg": [0, 60, 60, -75, 60],
}


def scenario(path: dict[str, Any], **more: Any) -> dynsim.Scenario:
    """An arm whose hand follows a path with all joints; other sections replace or extend its own."""
    joints = [f"joint_{k}" for k in range(1, 6)]
    data: dict[str, Any] = {"name": "arm", "duration_s": 0.5, "plant": ARM, "record": {"rate_hz": 50}} | more
    return scenario_from_resolved(data | {"controller": {"type": "joint_pd", "hand": {"joints": joints, "path": path}}})


def at_start(built: dynsim.Scenario) -> np.ndarray:
    """Position of the hand in the start posture."""
    model = dynsim.build_model(built)
    return model.point_position(*model.robot.hand, model.robot.initial)


def paths(folder: Path, points: np.ndarray) -> dict[str, dict[str, Any]]:
    """Paths of each kind through these points; the circle has its centre at the first point."""
    times = [0.0, 0.2, 0.4]
    rows = [f"{t},{','.join(map(repr, point))}" for t, point in zip(times, points.tolist(), strict=True)]
    (folder / "path.csv").write_text("\n".join(["t_s,x_m,y_m,z_m", *rows]), encoding="utf-8")
    return {
        "line": {"type": "line", "from_m": points[0].tolist(), "to_m": points[2].tolist(), "duration_s": 0.4},
        "circle": {"type": "circle", "center_m": points[0].tolist(), "radius_m": 0.02, "period_s": 0.5},
        "waypoints": {"type": "waypoints", "times_s": times, "points_m": points.tolist()},
        "csv": {"type": "csv", "file": str(folder / "path.csv")},
    }


@pytest.mark.parametrize("kind", ["line", "circle", "waypoints", "csv"])
def test_offsets_from_start_equal_coordinates_in_world(kind: str, tmp_path: Path) -> None:
    """The motions agree to the rounding of coordinates times the stiffness of the loop, far below the tolerance."""
    (tmp_path / "start").mkdir()
    offsets = np.array(OFFSETS)
    hand = at_start(scenario(paths(tmp_path, offsets)["line"] | {"frame": "start"}))
    world = dynsim.simulate(scenario(paths(tmp_path, hand + offsets)[kind]))
    start = dynsim.simulate(scenario(paths(tmp_path / "start", offsets)[kind] | {"frame": "start"}))
    assert np.abs(start["target_position"] - world["target_position"]).max() < 1e-15
    assert np.abs(start["q"] - world["q"]).max() < 1e-9
    assert np.ptp(start["target_position"], axis=0).max() > 0.02
    moved = paths(tmp_path / "start", offsets)[kind] | {"frame": "start", "origin_m": [0.0, 0.01, 0.02]}
    by = dynsim.simulate(scenario(moved))["target_position"] - start["target_position"]
    assert np.abs(by - [0.0, 0.01, 0.02]).max() < 1e-15


@pytest.mark.parametrize("height", [-0.05, -0.02, 0.0, 0.03])
def test_path_starts_at_hand_for_every_height_of_table(height: float) -> None:
    """``initial.on_surface`` moves the hand with the posture; the equilibrium does not move the path."""
    braced = scenario(
        {"type": "line", "frame": "start", "from_m": OFFSETS[0], "to_m": OFFSETS[2], "duration_s": 0.4},
        surfaces={"table": {"type": "box", "center_m": [0.7, 0.0, height - 0.05], "edges_m": [0.4, 0.4, 0.1]}},
        contacts={"law": "unilateral", "points": {"elbow": {"body": "link_4", "radius_m": 0.02, "surface": "table"}}},
        initial={"on_surface": ["elbow"], "equilibrium": True},
    )
    assert dynsim.check(braced).off_path == pytest.approx(0.0, abs=1e-15)
    record = dynsim.simulate(braced)
    assert np.abs(record["target_position"][0] - record["hand_position"][0]).max() < 1e-12
    assert np.abs(record["target_position"][-1] - record["target_position"][0] - OFFSETS[2]).max() < 1e-12


def test_errors_of_surfaces_do_not_move_the_path() -> None:
    """The path counts from the planned start, so that a displaced surface shows as an error of the hand."""
    line = {"type": "line", "frame": "start", "from_m": OFFSETS[0], "to_m": OFFSETS[2], "duration_s": 0.4}
    sections = {
        "surfaces": {"floor": {"type": "plane", "point_m": [0.0, 0.0, -0.02]}},
        "contacts": {"law": "unilateral", "points": {"elbow": {"body": "link_4", "radius_m": 0.02}}},
        "initial": {"on_surface": ["elbow"]},
    }
    planned = scenario(line, **sections)
    wrong = scenario(line, **sections, surface_error={"shift_m": [0.0, 0.0, -0.005]})
    target = dynsim.simulate(wrong)["target_position"]
    assert np.array_equal(target, dynsim.simulate(planned)["target_position"])
    assert np.linalg.norm(at_start(wrong) - target[0]) > 0.005


@pytest.mark.parametrize("tool", ["flange", "hand"])
def test_orientation_counts_from_the_start(tool: str, tmp_path: Path) -> None:
    """Angles of zero keep the orientation of the start; other angles turn it about the axes of the world."""
    (tmp_path / "turned.urdf").write_text(TURNED.replace("TOOL", tool), encoding="utf-8")
    motor = {
        "type": "dc", "torque_constant_N_m_per_A": 0.2, "resistance_ohm": 1.0, "inductance_H": 1e-3,
        "rotor_inertia_kg_m2": 1e-2, "gear_ratio": 3.0,
    }  # fmt: skip
    data = {
        "name": "turned",
        "duration_s": 0.5,
        "plant": {
            "type": "urdf_arm", "file": str(tmp_path / "turned.urdf"), "motor": motor, "hand": {"body": tool},
            "initial_deg": {"a": 20.0, "b": 60.0, "c": -40.0},
        },
        "controller": {
            "type": "joint_pd",
            "hand": {
                "joints": ["a", "b", "c"],
                "orientation": {"rpy_deg": [0.0, 0.0, 0.0]},
                "path": {
                    "type": "line", "frame": "start", "from_m": [0.0, 0.0, 0.0], "to_m": [0.02, 0.0, -0.03],
                    "duration_s": 0.4,
                },
            },
        },
        "initial": {"equilibrium": True},
    }  # fmt: skip
    record = dynsim.simulate(scenario_from_resolved(data))
    assert record["hand_turn_error"][0] < 1e-7  # an angle near zero, by its cosine
    assert record["hand_turn_error"].max() < 0.02
    data["controller"]["hand"]["orientation"] = {"rpy_deg": [0.0, 10.0, 0.0]}  # type: ignore[index]
    turned = dynsim.simulate(scenario_from_resolved(data))
    assert turned["hand_turn_error"][0] == pytest.approx(np.deg2rad(10.0), abs=1e-7)


def test_mobile_arm_paths_start_at_its_hand() -> None:
    """The shipped scenario follows the same path as one in the world that begins within 1e-9 m of the hand."""
    start = dynsim.load_scenario("mobile_reach")
    height = 0.588850080015
    line = {"frame": "world", "from_m": [0.295442325904, 0, height], "to_m": [1.8, 0, height]}
    keys = {f"controller.hand.path.{key}": value for key, value in line.items()}
    world = dynsim.load_scenario("mobile_reach", overrides=keys)
    t = np.linspace(0.0, 10.0, 11)
    targets = [build.controller(each, dynsim.build_model(each)).target(t) for each in (world, start)]
    assert np.abs(targets[0] - targets[1]).max() < 1e-9  # type: ignore[operator]


def test_plan_states_path_and_orientation_in_world() -> None:
    """A plan starts in another posture, from which the same offsets would be another path."""
    data = scene(7)
    world = task(scenario_from_resolved(data), Options())
    model = dynsim.build_model(scenario_from_resolved(data))
    hand = model.point_position(*model.robot.hand, model.robot.initial)
    path = data["controller"]["hand"]["path"]
    path |= {"frame": "start", "points_m": (np.array(path["points_m"]) - hand).tolist()}
    data["controller"]["hand"]["orientation"] = {"rpy_deg": [0.0, 0.0, 0.0]}
    start = task(scenario_from_resolved(data), Options())
    times = np.linspace(0.0, 10.0, 21)
    assert np.abs(start.targets(times) - world.targets(times)).max() < 1e-15
    assert np.abs(start.turn - hand_turn(model, model.robot.initial)).max() < 1e-15
    shared = planned_scenario.shared_sections(start)
    shared["plant"] = {**shared["plant"]}
    shared["plant"]["chain"] = [{**link, "initial_deg": 5.0} for link in shared["plant"]["chain"]]  # another posture
    shared["controller"] |= {"joints": {"joint_1": {"times_s": [0.0, 1.0], "angles_deg": [5.0, 6.0]}}}
    planned = scenario_from_resolved(shared)
    control = build.controller(planned, dynsim.build_model(planned))
    assert np.abs(control.target(times) - world.targets(times)).max() < 1e-14
    assert np.abs(control.orientation - start.turn).max() < 1e-14


def test_messages_of_paths_from_the_start() -> None:
    line = {"type": "line", "frame": "start", "from_m": [0, 0, 0], "to_m": [0.1, 0, 0], "duration_s": 0.4}
    with raises(ScenarioError, "controller.hand.path.frame", "'hand'", "'start'"):
        scenario(line | {"frame": "hand"})
    with raises(UnreachableReference, "controller.hand.path", "(1.688, 0, 0.1793)"):
        dynsim.simulate(scenario(line | {"to_m": [2.0, 0.0, 0.0]}))
