"""Linear equations of a simulation, without contacts and in every contact mode, against independent equations.

Without contacts these are Pinocchio's and closed forms; with contacts, differences of dense equations that are built
here from M, h and point Jacobians.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import expm
from support.messages import raises
from support.pinocchio_oracle import Oracle

import dynsim
from dynsim import DynsimError, Simulation, load_scenario
from dynsim.model.surfaces import Quadric
from dynsim.scenario import build
from dynsim.scenario.reading import scenario_from_resolved

Function = Callable[[np.ndarray], np.ndarray]


def parts(table: np.ndarray, axis: int = -1) -> list[np.ndarray]:
    """Columns (axis -1) or rows (axis 0) of positions, rates and currents: each joint has its motor."""
    return np.split(table, 3, axis=axis)


def central(function: Function, x: np.ndarray, step: float) -> np.ndarray:
    """Derivative of a function of x, by central differences of fourth order."""
    columns = []
    for e in step * np.eye(len(x)):
        near, far = (function(x + k * e) - function(x - k * e) for k in (1, 2))
        columns.append((8.0 * near - far) / (12.0 * step))
    return np.stack(columns, axis=1)


def assert_near(actual: np.ndarray, expected: np.ndarray, bound: float) -> None:
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=bound * np.abs(expected).max())


def test_a_free_arm_is_that_of_pinocchio_with_its_motors() -> None:
    """ABA's derivatives with rotors, and L di/dt = k_p (q_d − q) + k_d (v_d − v) − R i − K_m v, to 1e-10."""
    simulation = Simulation(load_scenario("elbow_comparison", "no_elbow"))
    state = simulation.advance(0.3)
    linear = simulation.linearize(["command", "reference", "reference_rate"], ["hand_position", "voltage"])
    A, B, C, D = linear
    model, n = simulation.model, simulation.model.n
    oracle = Oracle(model.robot)
    oracle.model.armature = oracle.to(model.armature)
    motors = model.robot.motors
    K, R, L = (np.array([getattr(m, name) for m in motors]) for name in ("joint_constant", "resistance", "inductance"))
    q, v, current = parts(linear.x)
    tau = K * current - model.damping * v
    by_q, by_v, inverse = pin.computeABADerivatives(oracle.model, oracle.data, *map(oracle.to, (q, v, tau)))
    inverse = np.triu(inverse) + np.triu(inverse, 1).T
    by_q, by_v, inverse = (oracle.back(oracle.back(unit).T).T for unit in (by_q, by_v, inverse))
    positions, rates, currents = parts(A)
    zero, unit = np.zeros((n, n)), np.eye(n)
    options = simulation.scenario.controller
    k_p, k_d = np.diag(np.full(n, options.k_p_V_per_rad)), np.diag(np.full(n, options.k_d_V_s_per_rad))
    by_inductance = np.diag(1.0 / L)
    assert_near(positions, np.vstack([zero, by_q, -by_inductance @ k_p]), 1e-9)
    assert_near(
        rates, np.vstack([unit, by_v - inverse @ np.diag(model.damping), -by_inductance @ (k_d + np.diag(K))]), 1e-9
    )
    assert_near(currents, np.vstack([zero, inverse @ np.diag(K), -by_inductance @ np.diag(R)]), 1e-9)
    assert_near(parts(B, 0)[2], by_inductance @ np.hstack([unit, k_p, k_d]), 1e-9)
    assert not np.vstack(parts(B, 0)[:2]).any()
    _, jacobian = model.point_position_and_jacobian(*model.robot.hand, q)
    assert_near(C[:3, :n], jacobian, 1e-9)
    assert not C[:3, n:].any()
    assert_near(np.hstack(parts(C[3:])[:2]), -np.hstack([k_p, k_d]), 1e-9)
    assert_near(D[3:], np.hstack([unit, k_p, k_d]), 1e-9)
    # The error is known to a factor of ten; the rows of currents are linear, and nearly exact.
    exact = np.hstack([by_q, by_v - inverse @ np.diag(model.damping), inverse @ np.diag(K)])
    true = (np.abs(parts(A, 0)[1] - exact) / np.abs(exact).max(axis=1, keepdims=True)).max()
    assert 0.1 * true < linear.error < 10.0 * true
    # Of a step that ends there; the state of advance() is between two.
    np.testing.assert_allclose(linear.x, np.concatenate([state.q, state.v, state.current]), atol=1e-5)


def constrained(simulation: Simulation, modes: dict[str, str], smoothing: float) -> tuple[Function, Function]:
    """dv/dt and normal forces as functions of (q, v, i), from M, h, point Jacobians and one system of equations.

    M v̇ + h = K i − D v + Σ Jᵀ f,  and of each closed contact  n·(J v̇ + J̇ v) + v·Q v/|∇C| = 0, with f along n and slip
    where it slides, and J v̇ + J̇ v = 0 where it sticks. Forces that no joint feels are the least ones.
    """
    model, scenario = simulation.model, simulation.scenario
    points = {contact.name: contact for contact in build.contacts(scenario)}
    closed = [points[name] for name, mode in modes.items() if mode != "open"]
    q0 = simulation.state.q
    K = np.zeros((model.n, len(model.robot.motors)))
    for a, motor in enumerate(model.robot.motors):
        K[model.joint_names.index(motor.joint), a] = motor.joint_constant

    def geometry(contact: object, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
        at, J = model.point_position_and_jacobian(contact.body, contact.point, q)
        near, far = (
            model.point_jacobian(contact.body, contact.point, q + k * 1e-3 * v)
            - model.point_jacobian(contact.body, contact.point, q - k * 1e-3 * v)
            for k in (1, 2)
        )
        return at, J, (8.0 * near - far) @ v / 12e-3

    def solve(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q, v, i = parts(x)
        rows, forces, right, normals = [], [], [], []
        for contact in closed:
            at, J, drift = geometry(contact, q, v)
            assert isinstance(contact.surface, Quadric)
            gradient = contact.surface.Q @ at + contact.surface.b
            slope = np.linalg.norm(gradient)
            n, speed = gradient / slope, J @ v
            normals.append(len(rows))
            if modes[contact.name] == "sticking":
                # Tangents stay those of the place where it is held; the normal is that of the surface at the point.
                normal = contact.surface.normal(model.point_position(contact.body, contact.point, q0))
                base = np.vstack([n, np.linalg.svd(normal[None])[2][1:]])
                rows += list(base @ J)
                forces += list(base @ J)
                right += list(-base @ drift)
                continue
            slip = speed - n * (n @ speed)
            t = slip / np.sqrt(slip @ slip + smoothing**2)
            rows.append(n @ J)
            forces.append((n - contact.friction * t) @ J)
            right.append(-n @ drift - speed @ contact.surface.Q @ speed / slope)
        m, p = model.n, len(rows)
        system = np.zeros((m + p, m + p))
        system[:m, :m] = model.mass_matrix(q) + np.diag(model.armature)
        if p:
            system[:m, m:], system[m:, :m] = -np.array(forces).T, np.array(rows)
        applied = K @ i if len(i) else np.zeros(m)
        loads = applied - model.damping * v - model.bias_forces(q, v)
        actual = np.linalg.lstsq(system, np.concatenate([loads, right]), rcond=1e-12)[0]
        return actual[:m], actual[m:][normals]

    return lambda x: solve(x)[0], lambda x: solve(x)[1]


CASES = {
    "glued, both slide": ("elbow_comparison", "two_elbows", 0.5, {"sliding"}, 1e-3),
    "glued to a cylinder": ("brace_on_cylinder", "glued", 1.5, {"sliding"}, 1e-3),
    "real, slides on a cylinder": ("brace_on_cylinder", "real", 1.5, {"sliding"}, 0.0),
    "real, sticks on a cylinder": ("brace_on_cylinder", "real", 0.5, {"sticking"}, 0.0),
    "real, one open, one slides": ("elbow_comparison_floor", "two_elbows", 0.2, {"open", "sliding"}, 0.0),
    "real, one sticks": ("wall_push", None, 0.3, {"sticking"}, 0.0),
}


# A program of its own.
LONG = {"real, slides on a cylinder"}


@pytest.mark.parametrize("case", [pytest.param(c, marks=[pytest.mark.long] if c in LONG else []) for c in CASES])
def test_every_contact_mode_against_differences(case: str) -> None:
    """∂v̇/∂x, and that of the normal forces, to 1e-7 of the largest entry."""
    name, variant, time, modes, smoothing = CASES[case]
    simulation = Simulation(load_scenario(name, variant))
    simulation.advance(time)
    linear = simulation.linearize([], ["contact_normal_force"])
    assert set(linear.modes.values()) == modes
    acceleration, force = constrained(simulation, linear.modes, smoothing)
    n = simulation.model.n
    assert_near(parts(linear.xdot)[1], acceleration(linear.x), 1e-9)
    expected = central(acceleration, linear.x, 3e-5)
    assert_near(parts(linear.A, 0)[1], expected, 1e-7)
    np.testing.assert_allclose(parts(parts(linear.A, 0)[0])[1], np.eye(n), atol=1e-12)
    closed = [k for k, mode in enumerate(linear.modes.values()) if mode != "open"]
    assert_near(linear.C[closed], central(force, linear.x, 3e-5), 1e-7)
    away = [k for k, mode in enumerate(linear.modes.values()) if mode == "open"]
    assert not linear.C[away].any()


def test_pushes_and_commands_act_as_they_do_in_the_simulation() -> None:
    """B of a force on the hand's body and of a voltage: what one more newton and volt change, with contacts closed."""
    simulation = Simulation(load_scenario("elbow_comparison_floor", "elbow_7"))
    simulation.advance(0.4)
    linear = simulation.linearize(["force.link_10.z", "torque.link_10", "command.joint_3"], ["vdot"])
    assert linear.inputs[:2] == ("force.link_10.z", "torque.link_10.x")
    model, q = simulation.model, linear.x[: simulation.model.n]
    n = model.n
    contact = build.contacts(simulation.scenario)[0]
    _, J_c = model.point_position_and_jacobian(contact.body, contact.point, q)
    slip = J_c @ parts(linear.x)[1]
    along = np.array([slip[0], slip[1], 0.0]) / np.hypot(slip[0], slip[1])
    # M̄ v̇ = Jᵀ F + f (n − μ t)ᵀ J_c and n·J_c v̇ = 0.
    friction = (np.array([0.0, 0.0, 1.0]) - contact.friction * along) @ J_c
    M = model.mass_matrix(q) + np.diag(model.armature)
    system = np.block([[M, -friction[:, None]], [J_c[2:], np.zeros((1, 1))]])
    J = model.point_jacobian("link_10", np.zeros(3), q)
    expected = np.linalg.solve(system, np.concatenate([J[2], [0.0]]))[:n]
    assert_near(parts(linear.B, 0)[1][:, 0], expected, 1e-8)
    assert_near(linear.D[:, 0], expected, 1e-8)
    inductance = simulation.robot.motors[2].inductance
    column = np.zeros(3 * n)
    parts(column)[2][2] = 1.0 / inductance
    assert_near(linear.B[:, 4], column, 1e-8)


@pytest.mark.parametrize("encoders", [False, True])
def test_a_sampled_controller_is_the_continuous_one_of_its_law(encoders: bool) -> None:
    """L di/dt = k_p (q_d − q) + k_d (v_d − v) − R i − K_m v; a command that the caller holds follows nothing."""
    sampled: dict[str, object] = {"controller.sample_time_s": 1e-3}
    if encoders:
        sampled["sensors"] = {"encoders": {"resolution_deg": 0.01, "delay_s": 1e-3}}
    simulations = [Simulation(load_scenario("elbow_comparison", "no_elbow", more)) for more in ({}, sampled)]
    state = simulations[0].advance(0.1)
    assert np.abs(state.v).max() > 0.01
    linear = []
    for simulation in simulations:
        simulation = Simulation(simulation.scenario, state=state)
        simulation.set_command("joint_2", 1.0)
        linear.append(simulation.linearize(["command", "reference", "reference_rate"], ["voltage"]))
    for continuous, held in zip(*linear, strict=True):
        np.testing.assert_array_equal(held, continuous)
    options, motors = simulations[1].scenario.controller, simulations[1].robot.motors
    follows = np.array([motor.joint != "joint_2" for motor in motors])
    L = np.array([motor.inductance for motor in motors])
    k_p, k_d = (np.diag(follows * gain / L) for gain in (options.k_p_V_per_rad, options.k_d_V_s_per_rad))
    back_emf = np.diag([motor.joint_constant for motor in motors] / L)
    positions, rates, _ = parts(parts(linear[1].A, 0)[2])
    assert_near(positions, -k_p, 1e-9)
    assert_near(rates, -(k_d + back_emf), 1e-9)
    by_command, by_reference, _ = parts(parts(linear[1].B, 0)[2])
    assert_near(by_command, np.diag(1.0 / L), 1e-9)
    assert_near(by_reference, k_p, 1e-9)


def test_the_simulation_goes_on_as_if_nobody_had_looked() -> None:
    records = []
    for looked in (False, True):
        simulation = Simulation(load_scenario("elbow_comparison_floor", "two_elbows", {"duration_s": 0.5}))
        if looked:
            simulation.linearize()
        simulation.advance(0.123)
        if looked:
            simulation.linearize()
        simulation.advance(0.5)
        records.append(simulation.record())
    for name in ("q", "current", "contact_force"):
        np.testing.assert_array_equal(records[0][name], records[1][name])


def test_a_linear_step_is_the_change_of_the_simulation() -> None:
    """Runs of a wheeled arm from states that differ by δx differ by exp(A t) δx."""
    scenario = load_scenario("mobile_reach", overrides={"integrator.rtol": 1e-12, "integrator.atol": 1e-13})
    simulation = Simulation(scenario)
    simulation.advance(0.2)
    linear, start = simulation.linearize([], []), simulation.state
    duration, change = 1e-4, np.zeros(len(linear.x))
    nq = len(start.q)
    change[nq : nq + len(start.v)] = 1e-4
    ends = []
    for side in (-1.0, 1.0):
        moved = dynsim.State(start.time, start.q, start.v + side * change[nq : nq + len(start.v)], start.current)
        other = Simulation(scenario, state=moved)
        end = other.advance(start.time + duration)
        ends.append(np.concatenate([end.q, end.v, end.current]))
    # What A changes by within the time is left.
    assert_near(0.5 * (ends[1] - ends[0]), expm(duration * linear.A) @ change, 2e-6)


@pytest.mark.parametrize(
    ("inputs", "outputs", "names"),
    [
        (["comand.joint_1"], [], ["comand.joint_1", "command.joint_1"]),
        ([], ["hand"], ["'hand'", "hand_position"]),
        ("command", "q", []),
    ],
)
def test_names_are_families_or_one_of_them(inputs: object, outputs: object, names: list[str]) -> None:
    simulation = Simulation(load_scenario("elbow_comparison", "no_elbow"))
    if not names:
        linear = simulation.linearize(inputs, outputs)
        assert (linear.B.shape, linear.C.shape) == ((30, 10), (10, 30))
        return
    with raises(DynsimError, *names):
        simulation.linearize(inputs, outputs)


def test_time_stepping_is_refused_in_words() -> None:
    simulation = Simulation(load_scenario("elbow_comparison_floor", overrides={"integrator.method": "time_stepping"}))
    with raises(DynsimError, "Simulation.linearize", "integrator.method: auto"):
        simulation.linearize()


@pytest.mark.parametrize(
    ("name", "variant", "changes", "blocked"),
    [
        ("elbow_comparison", "no_elbow", {}, 0),
        ("elbow_comparison_floor", "elbow_7", {"contacts.friction": 0.8}, 3),  # sticks
        ("elbow_comparison_floor", "elbow_7", {"contacts.friction": 0.0}, 1),  # slides
    ],
)
def test_the_reduced_system_has_the_free_motions_only(name: str, variant: str, changes: dict, blocked: int) -> None:
    """It loses two zero eigenvalues for each blocked direction, keeps the others, and moves no contact."""
    changes = {"controller.hand": None, "duration_s": 2.5, **changes}
    simulation = Simulation(load_scenario(name, variant, changes))
    simulation.advance(2.0)
    whole = simulation.linearize(outputs=["hand_position", "contact_gap"])
    small = simulation.linearize(outputs=["hand_position", "contact_gap"], reduced=True)
    assert len(small.states) == len(small.A) == len(whole.A) - 2 * blocked
    assert small.basis is not None
    assert small.basis.shape == (30, 30 - 2 * blocked)
    ours, theirs = (np.sort_complex(np.linalg.eigvals(linear.A)) for linear in (small, whole))
    lasting = theirs[np.argsort(np.abs(theirs))[2 * blocked :]]
    assert_near(ours, np.sort_complex(lasting), 1e-6)
    assert_near(whole.A @ small.basis, small.basis @ small.A, 1e-6)
    gaps = [k for k, label in enumerate(whole.outputs) if label.startswith("contact_gap.elbow_7")]
    assert np.abs(small.C[gaps]).max(initial=0.0) < (1e-9 if blocked else np.inf)
    # The same response of the hand to a voltage, at every frequency.
    for frequency in (1.0, 30.0, 300.0):
        response = [
            linear.C[:3] @ np.linalg.solve(1j * frequency * np.eye(len(linear.A)) - linear.A, linear.B)
            for linear in (whole, small)
        ]
        assert np.abs(response[1] - response[0]).max() < 1e-6 * np.abs(response[0]).max()


def three_links(**link: object) -> dict:
    """Resolved scenario of three links with stiff loops under gravity."""
    motor = {"type": "wang_minami"}
    links = {"mass_kg": 0.3, "length_m": 0.3, "radius_m": 0.02, "damping_N_m_s_per_rad": 0.5, "motor": motor} | link
    chain = [{"axis": "z", "length_m": 0.0}, {"axis": "y", "initial_deg": 60}, {"axis": "y", "initial_deg": 70}]
    plant = {"type": "serial_arm", "base": {"position_m": [0, 0, 0.3]}, "link": links, "chain": chain}
    control = {"type": "joint_pd", "k_p_V_per_rad": 200, "k_d_V_s_per_rad": 8}
    law = {"contacts": {"law": "unilateral", "friction": 2.0}}
    return {"name": "arm", "duration_s": 4.0, "plant": plant, "controller": control, **law}


@pytest.mark.parametrize("holds", ["friction", "brakes", "contact"])
def test_reduced_system_has_only_currents_if_every_joint_is_blocked(holds: str) -> None:
    data = three_links(**({"friction_N_m": 5.0} if holds == "friction" else {}))
    if holds == "contact":
        data["surfaces"] = {"floor": {"type": "plane"}}
        data["contacts"]["points"] = {"tip": {"body": "link_3", "point_m": [0, 0, 0.3], "surface": "floor"}}
        data["initial"] = {"on_surface": ["tip"]}
    simulation = Simulation(scenario_from_resolved(data))
    simulation.advance(1.0)
    if holds == "brakes":
        for joint in simulation.robot.joint_names[1:]:
            simulation.set_brake(joint, closed=True)
        partly = simulation.linearize(reduced=True)
        simulation.set_brake("joint_1", closed=True)
        assert partly.states[:2] == ("q.free_1", "v.free_1")
        assert len(partly.states) == 5
        assert np.abs(partly.basis[[1, 2, 4, 5]]).max() < 1e-12
    small = simulation.linearize(["command", "force.link_3"], ["hand_position"], reduced=True)
    assert small.states == ("current.joint_1", "current.joint_2", "current.joint_3")
    assert not small.B[:, 3:].any()
    motor = simulation.robot.motors[0]
    assert_near(np.linalg.eigvals(small.A).real, np.full(3, -motor.resistance / motor.inductance), 1e-9)


def test_reduced_system_keeps_heavy_bodies_next_to_a_tiny_one() -> None:
    ball = {"shape": "sphere", "mass_kg": 1e-5, "radius_m": 1e-3, "position_m": [2, 0, 5]}
    box = {"mass_kg": 1000.0, "size_m": [0.5, 0.5, 0.5], "position_m": [4, 0, 5]}
    changes = {"contacts.law": "unilateral", "objects": {"box": box, "ball": ball}}
    simulation = Simulation(load_scenario("single_pendulum", None, changes))
    small = simulation.linearize(["force"], ["vdot"], reduced=True)
    assert len(small.states) == 2 * (1 + 6 + 6)
    whole = simulation.linearize(["force"], ["vdot"])
    assert_near(small.D, whole.D, 1e-12)
    for body, mass in (("box", 1000.0), ("ball", 1e-5)):
        push = small.inputs.index(f"force.{body}.z")
        moved = (small.basis @ small.B)[len(small.x) // 2 :, push]
        assert np.linalg.norm(moved) == pytest.approx(1.0 / mass, rel=1e-9)


def test_reduced_system_keeps_the_poles_of_an_arm_with_a_tiny_loose_link() -> None:
    data = three_links()
    tiny = {"mass_kg": 2e-5, "length_m": 3e-3, "radius_m": 1e-4, "damping_N_m_s_per_rad": 1e-6, "motor": None}
    data["plant"]["chain"].append({"axis": "y", "initial_deg": 80} | tiny)
    simulation = Simulation(scenario_from_resolved(data))
    small, whole = simulation.linearize(reduced=True), simulation.linearize()
    assert len(small.states) == len(whole.states) == 11
    ours, theirs = (np.sort_complex(np.linalg.eigvals(linear.A)) for linear in (small, whole))
    np.testing.assert_allclose(ours, theirs, rtol=1e-6)


def test_a_reduced_state_is_that_of_a_free_motion() -> None:
    changes = {"controller.hand": None, "duration_s": 2.5, "contacts.friction": 0.8}
    simulation = Simulation(load_scenario("elbow_comparison_floor", "elbow_7", changes))
    simulation.advance(2.0)
    small = simulation.linearize(reduced=True)
    assert small.basis is not None
    z = np.random.default_rng(0).normal(size=len(small.states))
    assert_near(small.reduced_state(small.x + small.basis @ z), z, 1e-10)
    simulation.set_wrench("link_10", force=[0.0, 0.0, -0.5])
    state = simulation.advance(2.02)
    x = np.concatenate([state.q, state.v, state.current])
    off = x - small.x - small.basis @ small.reduced_state(x)
    assert np.abs(off[:10]).max() < 1e-3 * np.abs((x - small.x)[:10]).max()


def test_fast_motion_has_no_reduced_system() -> None:
    simulation = Simulation(load_scenario("elbow_comparison_floor", "elbow_7"))
    simulation.advance(0.05)
    with raises(DynsimError, "near rest"):
        simulation.linearize(reduced=True)
