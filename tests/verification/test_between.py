"""Bodies that touch each other, against closed forms, conservation laws and independent methods."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import yaml

from dynsim import Record, load_scenario, simulate
from dynsim.errors import DynsimError
from dynsim.record.quaternion import rotated
from dynsim.scenario.schema import SceneObject

POST = {
    "type": "serial_arm",
    "chain": [{"axis": "y", "length_m": 0.1, "mass_kg": 0.1}],
    "base": {"position_m": [0, 0, 9]},
}
FLOOR = {"floor": {"type": "plane"}}


def run(tmp_path, objects: dict[str, Any], *, between: list | None = None, weight: bool = False, **more: Any) -> Record:
    """A run of time stepping, or by the method of ``integrator``; without weight unless asked for."""
    law = {"law": "unilateral", "friction": more.pop("friction", 0.0), "restitution": more.pop("restitution", 0.0)}
    entries = [{"bodies": ["objects", "objects"]}] if between is None else between
    scenario = {
        "plant": POST | ({} if weight else {"gravity_m_s2": [0, 0, 0]}) | more.pop("plant", {}),
        "objects": objects,
        "contacts": law | {"between": entries},
        "integrator": {"method": "time_stepping", "step_s": more.pop("step", 1e-3)},
    } | more
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scenario), encoding="utf-8")
    return simulate(load_scenario(tmp_path / "scene.yaml"))


def ball(mass: float, radius: float, position: list[float], velocity: list[float] | None = None) -> dict[str, Any]:
    body = {"shape": "sphere", "mass_kg": mass, "radius_m": radius, "position_m": position}
    return body | ({} if velocity is None else {"velocity_m_s": velocity})


def pushed(body: str, force: list[float], duration: float = 0.1) -> dict[str, Any]:
    """A constant force on the centre of a body until a time."""
    times = [0.0, duration, duration + 1e-3, 10.0]
    return {
        "type": "samples",
        "interpolation": "linear",
        "body": body,
        "times_s": times,
        "force_N": [force, force, [0] * 3, [0] * 3],
    }


def rates(record: Record, body: str) -> tuple[np.ndarray, np.ndarray]:
    """Linear and angular velocity of a free object in the end, in the world and in the body."""
    columns = [k for k, label in enumerate(record.labels["v"]) if label.startswith(f"{body}.")]
    v = record["v"][-1, columns]
    return v[:3], v[3:6]


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_two_spheres_head_on(tmp_path, restitution):
    record = run(
        tmp_path,
        {"a": ball(1.0, 0.05, [0, 0, 0]), "b": ball(2.0, 0.07, [0.3, 0, 0])},
        loads={"push": pushed("a", [10.0, 0.0, 0.0])},
        restitution=restitution,
        duration_s=0.6,
    )
    a, b = rates(record, "a")[0], rates(record, "b")[0]
    before = a[0] + 2.0 * b[0]
    assert before == pytest.approx(1.005, abs=1e-6)
    # Without restitution, the penetration of the landing is undone at a speed that remains where nothing presses.
    error = 0.03 if restitution == 0.0 else 1e-12
    assert a[0] == pytest.approx(before * (1.0 - 2.0 * restitution) / 3.0, abs=error)
    assert b[0] == pytest.approx(before * (1.0 + restitution) / 3.0, abs=error)
    assert record.summary["energy_residual_relative"] < 1e-12


def test_stacks_carry_their_weight(tmp_path):
    g = 9.81
    record = run(
        tmp_path,
        {
            "a": ball(1.0, 0.05, [0, 0, 0.05]),
            "b": ball(2.0, 0.05, [0, 0, 0.15]),
            "c": {"size_m": [0.2, 0.2, 0.1], "mass_kg": 2, "position_m": [1.0, 0, 0.05]},
            "d": {"size_m": [0.1, 0.1, 0.1], "mass_kg": 1, "position_m": [1.02, 0, 0.15]},
        },
        surfaces=FLOOR,
        weight=True,
        friction=0.5,
        duration_s=0.3,
    )
    force = dict(zip(record.labels["contact_normal_force"], record["contact_normal_force"][-1], strict=True))
    assert force["a.floor"] == pytest.approx(3.0 * g, rel=1e-9)
    assert force["a-b"] == pytest.approx(2.0 * g, rel=1e-9)
    assert sum(f for name, f in force.items() if name.startswith("c") and name.endswith("floor")) == pytest.approx(
        3.0 * g, rel=1e-6
    )
    assert sum(f for name, f in force.items() if name.startswith(("d-c", "c-d"))) == pytest.approx(g, rel=1e-6)
    assert np.abs(record["v"][-1]).max() < 1e-9


THREE = {
    "a": ball(1.0, 0.05, [0, 0, 0]),
    "b": {"shape": "cylinder", "radius_m": 0.03, "length_m": 0.2, "mass_kg": 0.5, "position_m": [0.2, 0.02, 0.03]},
    "c": {"size_m": [0.1, 0.2, 0.15], "mass_kg": 2, "position_m": [0.4, -0.03, 0.0], "rpy_deg": [10, 20, 30]},
}
BALLS = {
    "a": ball(1.0, 0.05, [0, 0, 0]),
    "b": ball(0.5, 0.05, [0.2, 0.02, 0.03]),
    "c": ball(2.0, 0.06, [0.4, -0.03, 0]),
}


@pytest.mark.parametrize("objects", [BALLS, THREE], ids=["spheres", "solids"])
def test_momentum_and_angular_momentum_of_a_free_scene(tmp_path, objects):
    """Oblique impacts with friction and restitution."""
    record = run(
        tmp_path,
        objects,
        loads={"push": pushed("a", [20.0, 1.0, 0.5], 0.05)},
        friction=0.4,
        restitution=0.6,
        duration_s=0.6,
        record={"rate_hz": 1000},
    )
    masses = {name: body["mass_kg"] for name, body in objects.items()}
    inertias = {name: SceneObject.model_validate(body).inertia.tensor for name, body in objects.items()}
    momentum, spin = np.zeros((2, len(record), 3))
    for name, mass in masses.items():
        q, v = (record[kind][:, [x.startswith(f"{name}.") for x in record.labels[kind]]] for kind in ("q", "v"))
        position, attitude, velocity = q[:, :3], q[:, 3:7] / np.linalg.norm(q[:, 3:7], axis=1)[:, None], v[:, :3]
        own = rotated(attitude.T, (v[:, 3:6] @ inertias[name]).T).T
        momentum += mass * velocity
        spin += np.cross(position, mass * velocity) + own
    after = record.time > 0.06
    assert record["contact_normal_force"].max() > 1.0
    assert np.ptp(momentum[after], axis=0).max() < 1e-12
    assert np.ptp(spin[after], axis=0).max() < 1e-12
    assert record.summary["energy_residual_relative"] < 1e-12


def held(method: str, step: float, friction: float, tmp_path, solver: str = "articulated") -> Record:
    integrator = {"method": method} | (
        {"step_s": step} if method == "time_stepping" else {"rtol": 1e-10, "atol": 1e-12}
    )
    return run(
        tmp_path,
        {"ball": ball(0.2, 0.04, [-0.25, 0, 1.25])},
        plant={
            "chain": [
                {
                    "axis": "y",
                    "initial_deg": -60,
                    "length_m": 0.6,
                    "mass_kg": 1.0,
                    "radius_m": 0.03,
                    "damping_N_m_s_per_rad": 4.0,
                }
            ],
            "base": {"position_m": [0, 0, 1]},
        },
        between=[{"bodies": ["ball", "links"]}],
        weight=True,
        friction=friction,
        duration_s=0.3,
        integrator=integrator | {"solver": solver},
    )


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_a_sphere_that_falls_on_a_moving_capsule(tmp_path, friction):
    """Friction acts on both moving bodies; two event-driven methods agree, and time stepping converges to them."""
    exact, other = (held(method, 0.0, friction, tmp_path) for method in ("dopri5", "radau5"))
    assert np.abs(exact["q"][-1] - other["q"][-1]).max() < 1e-7
    errors = [
        float(np.abs(held("time_stepping", step, friction, tmp_path)["q"][-1] - exact["q"][-1]).max())
        for step in (2e-3, 1e-3, 5e-4, 2.5e-4)
    ]
    assert errors[0] < 1e-2
    assert math.log2(errors[0] / errors[-1]) > 2.0


def test_an_arm_lies_on_its_own_first_link(tmp_path):
    """The force follows from the moments about the joints."""
    plant = {
        "chain": [
            {
                "axis": "y",
                "initial_deg": 90,
                "length_m": 0.6,
                "mass_kg": 1.0,
                "radius_m": 0.03,
                "damping_N_m_s_per_rad": 50.0,
            },
            {
                "axis": "y",
                "initial_deg": -120,
                "length_m": 0.3,
                "mass_kg": 0.5,
                "radius_m": 0.02,
                "damping_N_m_s_per_rad": 1.0,
            },
            {
                "axis": "y",
                "initial_deg": -60,
                "length_m": 0.3,
                "mass_kg": 0.5,
                "radius_m": 0.02,
                "damping_N_m_s_per_rad": 0.1,
            },
        ],
        "base": {"position_m": [0, 0, 1]},
    }
    record = run(tmp_path, {}, plant=plant, between=[{"bodies": "self"}], weight=True, friction=0.2, duration_s=0.5)
    assert record["contact_gap"].min() > -2e-3
    assert record["contact_normal_force"].max() > 0.5
    assert record.summary["energy_residual_relative"] < 1e-10


def test_neighbours_and_ignored_pairs_do_not_touch(tmp_path):
    plant = {"chain": [{"axis": "y", "count": 4, "length_m": 0.2, "mass_kg": 0.2, "radius_m": 0.02}]}
    record = run(
        tmp_path, {}, plant=plant, between=[{"bodies": "self", "ignore": [["link_1", "link_3"]]}], duration_s=0.01
    )
    pairs = {tuple(sorted(name.split("_")[1:2])) for name in record.labels["contact_gap"]}
    assert pairs
    text = " ".join(record.labels["contact_gap"])
    assert "link_1-link_4" in text or "link_4-link_1" in text
    assert "link_1-link_3" not in text
    assert "link_1-link_2" not in text


@pytest.mark.parametrize(
    ("between", "text"),
    [
        ([{"bodies": ["a", "x"]}], "unknown body 'x'"),
        ([{"bodies": ["a"]}], "two bodies"),
    ],
)
def test_wrong_pairs_are_errors(tmp_path, between, text):
    with pytest.raises(DynsimError, match=text):
        run(tmp_path, {"a": ball(1.0, 0.05, [0, 0, 0])}, between=between, duration_s=0.01)


def test_overlap_at_the_start_is_an_error(tmp_path):
    objects = {"a": ball(1.0, 0.05, [0, 0, 0]), "b": ball(1.0, 0.05, [0.08, 0, 0])}
    with pytest.raises(DynsimError, match=r"a and b overlap by 0\.02 m .*move a"):
        run(tmp_path, objects, duration_s=0.01)


def test_many_pairs_need_time_stepping(tmp_path):
    boxes = {f"b{k}": {"size_m": [0.1, 0.1, 0.1], "mass_kg": 1, "position_m": [0.2 * k, 0, 0]} for k in range(2)}
    with pytest.raises(DynsimError, match=r"28 candidates .* time_stepping"):
        run(tmp_path, boxes, duration_s=0.01, integrator={"method": "dopri5"})


def test_bilateral_law_is_refused(tmp_path):
    with pytest.raises(DynsimError, match=r"contacts\.between.*unilateral"):
        run(
            tmp_path,
            BALLS,
            duration_s=0.01,
            contacts={"law": "bilateral", "between": [{"bodies": ["a", "b"]}]},
            integrator={"method": "dopri5"},
        )
