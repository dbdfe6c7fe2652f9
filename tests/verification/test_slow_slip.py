"""Points that land while all of them slip so slowly that they are all but at rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.random_robots import assemble
from support.stepping_systems import plane

from dynsim import load_scenario, simulate
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.state import OUT_FORCE, OUT_VECTOR
from dynsim.model.description import Contact, Inertia, Link, Load, Robot, vector
from dynsim.scenario import scenario_from_resolved

# Drawn at random. A push lifts the hand off its ball for a moment. When it lands again both points of the last link
# slip at 1e-7 to 2e-6 m/s, in directions with which no forces agree; they may stick.
BRACED = """
duration_s: 0.21762562632865906
plant:
  type: serial_arm
  link:
    radius_m: 0.019432554065906774
    motor: {type: dc, torque_constant_N_m_per_A: 0.0302, resistance_ohm: 0.299, inductance_H: 8.23e-05,
      rotor_inertia_kg_m2: 1.42e-05, gear_ratio: 113.0, gear_damping_N_m_s_per_rad: 3e-06, voltage_limit_V: 24.0,
      peak_current_A: 12.0}
  chain:
    - {axis: z, length_m: 0.0, mass_kg: 0.47668193820866145, initial_deg: -0.17408081469863035}
    - {axis: y, length_m: 0.2290316433915182, mass_kg: 0.20756622558177096, initial_deg: 120.92986871812899}
    - {axis: y, length_m: 0.16509192987515214, mass_kg: 0.3070459539296102, initial_deg: -2.7793672869097747,
       limit_deg: [-3.925224017684724, -1.0605821907473505]}
    - {axis: y, length_m: 0.24115489371662263, mass_kg: 0.28024404578625506, initial_deg: -86.55121915463342,
       limit_deg: [-87.24117312731542, -85.51628819561041]}
controller:
  type: joint_pd
  k_p_V_per_rad: 15.52170723057591
  k_d_V_s_per_rad: 0.5820640211465966
  brace: optimal
  joints:
    joint_4:
      times_s: [0.0, 0.10881281316432953, 0.21762562632865906]
      angles_deg: [-86.55121915463342, -86.55121915463342, -86.55121915463342]
surfaces:
  floor: {type: sphere, center_m: [0.3422537247967443, 0.07439740163367127, -0.3189362076445127],
    radius_m: 0.12457012400351349}
  ball: {type: sphere, center_m: [0.4945817766027559, -0.0015026842162652618, 0.052378153006256555], radius_m: 0.03}
contacts:
  law: unilateral
  friction: 0.3164072339720011
  static_friction: 0.5423631616673215
  stribeck_m_s: 0.01
  points:
    elbow: {body: link_4, surface: floor, radius_m: 0.02}
    hand: {body: link_4, point_m: [0.0, 0.0, 0.24115489371662263], surface: ball, radius_m: 0.02}
loads:
  push:
    type: samples
    body: link_4
    times_s: [0.043525125265731816, 0.08705025053146363, 0.15233793843006133]
    force_N: [[0.0, 0.0, 0.0], [7.374169294714517, -2.734822236798465, -0.13165375699491566], [0.0, 0.0, 0.0]]
    torque_N_m: [[0.0, 0.0, 0.0], [0.15217842449401586, 0.12644320633301281, 0.28316102948046434], [0.05, 0.0, 0.0]]
    frame: body
    interpolation: linear
    point_m: [0.01, 0.0, 0.05]
integrator: {rtol: 1.0e-9, atol: 1.0e-11}
"""


@pytest.mark.long
@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_points_that_land_nearly_at_rest_stick(tmp_path: Path, method: str) -> None:
    path = tmp_path / "braced.yaml"
    path.write_text(BRACED.replace("integrator: {", f"integrator: {{method: {method}, "))
    record = simulate(load_scenario(path))
    assert record.time[-1] == pytest.approx(0.21762562632865906)
    assert any(event.kind == "landing" and event.name == "hand" for event in record.events)
    assert (record["contact_normal_force"] >= -1e-9).all()
    assert record.summary["energy_residual_relative"] < 1e-6


def test_slip_that_begins_slowly_takes_no_more_steps_the_tighter_the_tolerances() -> None:
    """Stribeck's friction falls with the slip, so that a pull that grows lets it begin without a jump of forces.

    Friction turns a slip of speed v at a rate that goes as 1/v: steps went as 1/atol, and runs stopped for it. Below
    the limit of slow slip it turns as fast as at the limit, which costs an explicit method steps once, at the start.
    """
    axes = [{"kind": "prismatic", "axis": axis, "length_m": 0, "mass_kg": 0.3} for axis in "zxy"]
    runs = []
    for rtol in (1e-8, 1e-10):
        config = {
            "duration_s": 0.4,
            "plant": {"type": "serial_arm", "chain": axes},
            "surfaces": {"floor": {"type": "plane"}},
            "contacts": {
                "law": "unilateral",
                "friction": 0.33,
                "static_friction": 0.46,
                "stribeck_m_s": 0.05,
                "points": {"foot": {"body": "link_3"}},
            },
            "loads": {
                "pull": {
                    "type": "samples",
                    "body": "link_3",
                    "times_s": [0, 0.1, 0.4],
                    "force_N": [[0, 0, 0], [3.6, 0, 0], [4.2, 2, 0]],
                    "interpolation": "linear",
                }
            },
            "integrator": {"method": "dopri5", "rtol": rtol, "atol": 1e-2 * rtol},
        }
        runs.append(simulate(scenario_from_resolved(config)))
        assert [event.kind for event in runs[-1].events] == ["slip_start"]
    loose, tight = runs
    assert tight["q"][-1] == pytest.approx(loose["q"][-1], abs=1e-6)
    assert tight.summary["steps"] < 2 * loose.summary["steps"] < 40_000


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
@pytest.mark.parametrize("share", [0.7, 1.5])
def test_friction_is_against_slow_slip_where_a_joint_breaks_loose(method: str, share: float) -> None:
    """A foot slides along x at a share of the limit of slow slip; a gust pushes it along y, and a disc on it turns.

    The disc breaks loose, so all modes are chosen again. The foot slides on: its friction is still μ m g along x.
    """
    mu, weight, slow, start = 0.4, 3.0 * 9.81, 1e-5, 0.01
    first, then = 5.0 * slow, share * slow
    links = (
        Link("up", "joint_z", None, "prismatic", vector(0, 0, 1), Inertia(0.0)),
        Link("along", "joint_x", "up", "prismatic", vector(1, 0, 0), Inertia(0.0)),
        Link("foot", "joint_y", "along", "prismatic", vector(0, 1, 0), Inertia(2.0)),
        Link("disc", "axle", "foot", "revolute", vector(0, 0, 1), Inertia(1.0, tensor=0.01 * np.eye(3)), friction=0.1),
    )
    coefficients = np.zeros((2, 6, 4))
    coefficients[:, 0, 0] = mu * weight - 3.0 * (first - then) / start
    gust, twist = coefficients.copy(), np.zeros((2, 6, 4))
    gust[1, 1, 0], twist[1, 5, 0] = 2.0 * mu * weight, 0.2
    knots = np.array([0.0, start, 1.0])
    loads = [
        Load("gust", "foot", np.zeros(3), False, knots, gust, True),
        Load("twist", "disc", np.zeros(3), False, knots, twist, True),
    ]
    foot = Contact("foot", "foot", np.zeros(3), plane(vector(0, 0, 1)), friction=mu)
    robot = Robot("foot", links, (), ("foot", np.zeros(3)))
    b = assemble(robot, [foot], loads=loads, real=True, dry=True, slow=slow)
    y = b.state(np.zeros(4), np.array([0.0, first, 0.0, 0.0]))
    run = b.new_run(y, np.array([0.0, start]), method, rtol=1e-8)
    b.finish(run._replace(breaks=np.array([start])))
    assert b.system.unilateral.dry_table[0, ku.DRY_HOLDS] == 0
    assert run.states("v")[-1, :3] == pytest.approx([0.0, then, 0.0], abs=1e-6 * slow)
    output = run.outputs("contact")[-1, 0]
    assert output[OUT_FORCE] == pytest.approx(weight)
    assert output[OUT_VECTOR : OUT_VECTOR + 3] == pytest.approx([-mu * weight, 0.0, weight], rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
@pytest.mark.parametrize("share", [-1.5, 0.1, 0.7])
def test_friction_of_a_point_that_begins_to_slip_is_that_of_the_choice(method: str, share: float) -> None:
    """A foot that creeps along y, at a share of the limit of slow slip, is pushed along x beyond its friction.

    Modes are chosen as if it were at rest: its friction is μ m g along x, whatever it creeps, and then along its slip.
    """
    mu, mass, slow, end = 0.4, 2.0, 1e-5, 1e-3
    weight = 9.81 * mass
    links = (
        Link("up", "joint_z", None, "prismatic", vector(0, 0, 1), Inertia(0.0)),
        Link("along", "joint_x", "up", "prismatic", vector(1, 0, 0), Inertia(0.0)),
        Link("foot", "joint_y", "along", "prismatic", vector(0, 1, 0), Inertia(mass)),
    )
    coefficients = np.zeros((1, 6, 4))
    coefficients[0, 0, 0] = 2.0 * mu * weight
    push = Load("push", "foot", np.zeros(3), False, np.array([0.0, 1.0]), coefficients, True)
    foot = Contact("foot", "foot", np.zeros(3), plane(vector(0, 0, 1)), friction=mu)
    b = assemble(Robot("foot", links, (), ("foot", np.zeros(3))), [foot], loads=[push], real=True, slow=slow)
    y = b.state(np.zeros(3), np.array([0.0, 0.0, share * slow]))
    run = b.finish(b.new_run(y, np.array([0.0, end]), method, rtol=1e-8))
    outputs, rates = run.outputs("contact")[:, 0], run.states("v")
    assert outputs[0, OUT_VECTOR : OUT_VECTOR + 3] == pytest.approx([-mu * weight, 0.0, weight], rel=1e-9, abs=1e-9)
    assert rates[-1, 1] == pytest.approx(mu * 9.81 * end, rel=1e-2)
    assert abs(rates[-1, 2]) < abs(share) * slow
