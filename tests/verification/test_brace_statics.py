"""Least-heat brace forces: conditions of optimality, or a certificate that no forces exist; limits and refusals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from support.messages import raises

import dynsim
from dynsim.compile.bracing import Brace, BracePlanner, BraceStatics, PreparedBraces, brace_rows
from dynsim.compile.model import Model
from dynsim.dynamics.contact.braces import statics
from dynsim.dynamics.contact.braces import statics as kb
from dynsim.errors import ModelError

seeds = st.integers(0, 2**32 - 1)
# Tolerance of components of virtual velocities and gradients, of about 1, that must be zero or not negative.
ROUNDING = 1e-9
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def arm() -> Model:
    """The published arm in its initial posture."""
    return dynsim.build_model(dynsim.load_scenario("elbow_comparison", variant="two_elbows"))


def elbows(**options) -> dict[str, Brace]:
    return {f"elbow_{k}": Brace(f"link_{k}", np.zeros(3), UP, friction=0.1, **options) for k in (4, 7)}


def free_torques(model: Model, q, v, vdot) -> np.ndarray:
    return model.inverse_dynamics(q, v, vdot) + model.armature * vdot + model.damping * v


def heat_weights(model: Model) -> np.ndarray:
    weights = np.zeros(model.n)
    for motor in model.robot.motors:
        weights[model.joint_names.index(motor.joint)] = (
            motor.resistance / (motor.torque_constant * motor.gear_ratio) ** 2
        )
    return weights


def limits(model: Model, v) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.zeros(model.n), np.zeros(model.n)
    for motor in model.robot.motors:
        j, constant = model.joint_names.index(motor.joint), motor.torque_constant * motor.gear_ratio
        low[j], high[j] = (
            constant * (side * motor.voltage_limit - constant * v[j]) / motor.resistance for side in (-1, 1)
        )
    return low, high


def least_work(brace: Brace, u: np.ndarray) -> float:
    """min u · f over all forces that the brace may have; −inf where it is unbounded."""
    normal = brace.normal / np.linalg.norm(brace.normal)
    u_n, u_t = float(u @ normal), u - (u @ normal) * normal
    if brace.sliding is None:
        slope = u_n - brace.friction * float(np.linalg.norm(u_t))
    else:
        along = brace.sliding - (brace.sliding @ normal) * normal
        slope = u_n - brace.friction * float(u_t @ along) / float(np.linalg.norm(along))
    if brace.normal_force is not None:
        return brace.normal_force * slope
    return brace.min_N * slope if slope >= -ROUNDING else -math.inf


def check_allowed(brace: Brace, f: np.ndarray, tolerance: float) -> None:
    normal = brace.normal / np.linalg.norm(brace.normal)
    f_n, f_t = float(f @ normal), f - (f @ normal) * normal
    if brace.normal_force is None:
        assert f_n >= brace.min_N - tolerance
    else:
        assert f_n == pytest.approx(brace.normal_force, abs=tolerance)
    if brace.sliding is None:
        assert np.linalg.norm(f_t) <= brace.friction * f_n + tolerance
    else:
        along = brace.sliding - (brace.sliding @ normal) * normal
        assert f_t == pytest.approx(-brace.friction * f_n * along / np.linalg.norm(along), abs=tolerance)


def check_optimal(model: Model, q, v, vdot, braces, answer: BraceStatics) -> None:
    """Equation of motion and constraints; and the duality gap: no allowed forces heat less, to first order."""
    free = free_torques(model, q, v, vdot)
    J = {name: model.point_jacobian(b.body, b.point, q) for name, b in braces.items()}
    scale = 1.0 + np.abs(free).max()
    balance = answer.torques + sum(J[name].T @ f for name, f in answer.forces.items()) - free
    assert np.abs(balance).max() <= 1e-11 * scale
    low, high = limits(model, v)
    assert (answer.torques >= low - 1e-8 * scale).all()
    assert (answer.torques <= high + 1e-8 * scale).all()
    for name, brace in braces.items():
        check_allowed(brace, answer.forces[name], 1e-8 * scale)
    weights = heat_weights(model)
    assert answer.heat == pytest.approx(weights @ answer.torques**2, rel=1e-12)
    if not np.isinf(high).all():
        return
    gap = 0.0
    for name, brace in braces.items():
        gradient = -2.0 * J[name] @ (weights * answer.torques) / (1.0 + answer.heat)
        gap += gradient @ answer.forces[name] - least_work(brace, gradient)
    # Heat is convex: this is the part of it that could be saved at most.
    # Braces close to the base take thousands of newtons to save the last bit: their rounding.
    largest = max(float(np.linalg.norm(f)) for f in answer.forces.values())
    assert abs(gap) <= 1e-9 * (1.0 + (largest / 500.0) ** 2)


def check_impossible(model: Model, q, v, vdot, braces, omega: np.ndarray) -> None:
    """The most that ω·(tau + Jᵀ f) can be is less than what it would have to be."""
    low, high = limits(model, v)
    omega = omega / np.abs(omega).max()
    # Rates of what is not limited are rounding; without a limit they would have to be exactly zero.
    assert (np.abs(omega[np.isinf(high)]) <= 1e-9).all()
    omega = np.where(np.isinf(high), 0.0, omega)
    most = float(np.where(np.isinf(high), 0.0, np.where(omega > 0.0, high, low)) @ omega)
    for brace in braces.values():
        most -= least_work(brace, -model.point_jacobian(brace.body, brace.point, q) @ omega)
    assert most < omega @ free_torques(model, q, v, vdot)


def random_case(rng: np.random.Generator, model: Model, limited: bool):
    q, v, vdot = rng.uniform(-2, 2, size=model.n), rng.normal(size=model.n), 2.0 * rng.normal(size=model.n)
    if limited:
        volts = 10.0 ** rng.uniform(-0.5, 2.0)
        motors = tuple(replace(motor, voltage_limit=volts) for motor in model.robot.motors)
        model = Model(replace(model.robot, motors=motors[int(rng.integers(0, 3)) :]))
    bodies = rng.choice(np.arange(4, 11), size=rng.integers(1, 4), replace=False)
    braces = {}
    for k in bodies:
        braces[f"brace_{k}"] = Brace(
            f"link_{k}",
            rng.normal(size=3) * 0.1,
            rng.normal(size=3),
            friction=float(rng.choice([0.0, rng.uniform(0.05, 1.0)])),
            min_N=float(rng.choice([0.0, 0.5, 2.0])),
            normal_force=float(rng.uniform(0.5, 10.0)) if rng.random() < 0.3 else None,
            sliding=rng.normal(size=3) if rng.random() < 0.3 else None,
        )
    return model, q, v, vdot, braces


@settings(max_examples=60)
@given(seeds)
def test_least_heat_of_any_braces(arm, seed):
    rng = np.random.default_rng(seed)
    model, q, v, vdot, braces = random_case(rng, arm, limited=False)
    answer = model.brace_statics(q, v, vdot, braces)
    assert answer.feasible
    assert answer.certificate is None
    check_optimal(model, q, v, vdot, braces, answer)
    for name, brace in braces.items():
        force = brace.normal_force
        assert answer.intervals[name] == ((brace.min_N, math.inf) if force is None else (force, force))


@settings(max_examples=60)
@given(seeds)
def test_limited_and_missing_motors_give_forces_or_a_certificate(arm, seed):
    rng = np.random.default_rng(seed)
    model, q, v, vdot, braces = random_case(rng, arm, limited=True)
    answer = model.brace_statics(q, v, vdot, braces)
    if not answer.feasible:
        check_impossible(model, q, v, vdot, braces, answer.certificate)
        return
    check_optimal(model, q, v, vdot, braces, answer)
    name, brace = next(iter(braces.items()))
    low, high = answer.intervals[name]
    assert low - 1e-6 <= answer.normal_forces[name] <= high + 1e-6
    if brace.normal_force is not None or high - low < 1e-3:
        return
    # Just inside of the ends it works, just outside there is a proof that it does not.
    for force, feasible in ((low, True), (high, True), (low - 0.01, False), (high + 0.01, False)):
        step = min(0.3 * (high - low), 1e-4) * (1.0 if force == low else -1.0 if force == high else 0.0)
        if math.isinf(force) or force + step <= 0.0 or (not feasible and force < brace.min_N):
            continue
        asked = {**braces, name: replace(brace, normal_force=force + step, min_N=0.0)}
        answer = model.brace_statics(q, v, vdot, asked)
        assert answer.feasible == feasible
        if not feasible:
            check_impossible(model, q, v, vdot, asked, answer.certificate)


def prepared(arm: Model, seed: int):
    """A random limited case as the tables of the kernels, and its answer."""
    model, q, v, vdot, braces = random_case(np.random.default_rng(seed), arm, limited=True)
    tables = PreparedBraces(model.robot, model.arrays, braces)
    return model, (q, v, vdot), braces, tables, tables.solve(q, v, vdot)


def test_what_programs_leave_behind_changes_nothing(arm):
    """An answer takes programs of several sizes: again, in tables that are full of NaN."""
    for seed in range(40):
        _, motion, _, tables, first = prepared(arm, seed)
        for table in (tables.arrays.inside, *tables.arrays.program):
            if table.dtype == np.float64:
                table[:] = np.nan
        again = tables.solve(*motion)
        np.testing.assert_array_equal(again.torques, first.torques)
        np.testing.assert_equal(again.certificate, first.certificate)
        np.testing.assert_equal(again.intervals, first.intervals)


def test_passive_joints_as_equations_give_a_certificate_too(arm):
    """Where braces could carry the passive joints, and limits forbid it; as a rule these are in cones first."""
    proofs = 0
    for seed in range(30):
        model, (q, v, vdot), braces, tables, answer = prepared(arm, seed)
        arrays, passive = tables.arrays, model.n - len(model.robot.motors)
        if answer.feasible or not 0 < passive < arrays.first[-1]:
            continue
        scale = statics.brace_rows(model.arrays, tables._ws, arrays)
        equations, cones = statics.constraints(arrays, scale, True, False)
        assert equations == passive
        assert statics.largest_margin(arrays, equations, cones, scale) < -statics.SLACK
        statics.contradiction(arrays, equations, cones, False)
        check_impossible(model, q, v, vdot, braces, arrays.certificate.copy())
        proofs += 1
    assert proofs >= 5


def test_a_brace_is_shortened_with_its_friction(arm):
    """Limits around the torques with all of its force scaled to the least: they hold there, and not beside it."""
    shortenings = 0
    for seed in range(40):
        model, motion, braces, tables, answer = prepared(arm, seed)
        name, brace = next(iter(braces.items()))
        if not answer.feasible or brace.normal_force is not None or answer.normal_forces[name] <= brace.min_N + 1e-6:
            continue
        arrays = tables.arrays
        J = model.point_jacobian(brace.body, brace.point, motion[0])
        shortened = answer.torques + (1.0 - brace.min_N / answer.normal_forces[name]) * J.T @ answer.forces[name]
        room = 1e-8 * (1.0 + np.abs(shortened))
        arrays.motors[:, kb.LOWER], arrays.motors[:, kb.UPPER] = shortened - room, shortened + room
        assert statics.possible_with_least(arrays, 0)
        arrays.motors[:, kb.LOWER] += 2.0 * room
        assert not statics.possible_with_least(arrays, 0)
        shortenings += brace.friction > 0.0
    assert shortenings >= 5


def test_published_posture_against_slsqp(arm):
    """The optimum without a least force leaves elbow 4 grazing; with one it has exactly that."""
    q, zeros = arm.robot.initial, np.zeros(arm.n)
    J = np.vstack([arm.point_jacobian(f"link_{k}", np.zeros(3), q) for k in (4, 7)])
    free, weights = free_torques(arm, q, zeros, zeros), heat_weights(arm)
    for least in (0.0, 0.5):
        answer = arm.brace_statics(q, zeros, zeros, elbows(min_N=least))
        result = minimize(
            lambda f: weights @ (free - J.T @ f) ** 2,
            np.array([0.0, 0.0, 3.0, 0.0, 0.0, 8.0]),
            jac=lambda f: -2.0 * J @ (weights * (free - J.T @ f)),
            constraints=[
                {
                    "type": "ineq",
                    "fun": lambda f, least=least: np.array(
                        [f[2] - least, f[5] - least]
                        + [0.1 * f[k + 2] - math.sqrt(f[k] ** 2 + f[k + 1] ** 2 + 1e-30) for k in (0, 3)]
                    ),
                }
            ],
            method="SLSQP",
            options={"ftol": 1e-16, "maxiter": 500},
        )
        assert answer.heat == pytest.approx(result.fun, rel=1e-8)
        assert answer.normal_forces["elbow_4"] == pytest.approx(least, abs=1e-8)
    commanded = {**elbows(), "elbow_4": replace(elbows()["elbow_4"], normal_force=3.0)}
    assert arm.brace_statics(q, zeros, zeros, commanded).heat > answer.heat


@pytest.mark.parametrize("joint", ["joint_2", "joint_4", "joint_6"])
def test_limits_that_hold_and_limits_that_bind(arm, joint):
    """Wide limits change nothing but give intervals; one that binds gives SLSQP's optimum, and costs heat."""
    q, zeros = arm.robot.initial, np.zeros(arm.n)
    free_of_limits = arm.brace_statics(q, zeros, zeros, elbows())
    j = arm.joint_names.index(joint)
    J = np.vstack([arm.point_jacobian(f"link_{k}", np.zeros(3), q) for k in (4, 7)])
    free, weights = free_torques(arm, q, zeros, zeros), heat_weights(arm)

    def limited(at_joint: float) -> Model:
        """Voltages that allow 50 N m, and less at one joint."""
        motors = []
        for motor in arm.robot.motors:
            torque = at_joint if motor.joint == joint else 50.0
            motors.append(replace(motor, voltage_limit=torque * motor.resistance / motor.joint_constant))
        return Model(replace(arm.robot, motors=tuple(motors)))

    wide = limited(50.0).brace_statics(q, zeros, zeros, elbows())
    assert np.array_equal(wide.torques, free_of_limits.torques)
    assert all(low == 0.5 and 0.5 < high < math.inf for low, high in wide.intervals.values())
    bound = 0.95 * abs(free_of_limits.torques[j])
    answer = limited(bound).brace_statics(q, zeros, zeros, elbows())
    assert answer.feasible
    assert abs(answer.torques[j]) == pytest.approx(bound, rel=1e-8)
    result = minimize(
        lambda f: weights @ (free - J.T @ f) ** 2,
        np.concatenate([answer.forces["elbow_4"], answer.forces["elbow_7"]]) + 0.1,
        jac=lambda f: -2.0 * J @ (weights * (free - J.T @ f)),
        constraints=[
            {
                "type": "ineq",
                "fun": lambda f: np.array(
                    [f[2] - 0.5, f[5] - 0.5]
                    + [0.1 * f[k + 2] - math.sqrt(f[k] ** 2 + f[k + 1] ** 2 + 1e-30) for k in (0, 3)]
                    + [bound - (free - J.T @ f)[j], bound + (free - J.T @ f)[j]]
                ),
            }
        ],
        method="SLSQP",
        options={"ftol": 1e-16, "maxiter": 500},
    )
    assert answer.heat == pytest.approx(result.fun, rel=1e-8)
    assert answer.heat > free_of_limits.heat


def test_one_brace_by_hand():
    """A level beam of two links, massless but for a tip: one support without friction takes what makes least heat."""
    arm = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
    q, zeros = np.array([math.radians(60.0)]), np.zeros(1)
    position = arm.point_position(*arm.robot.hand, q)
    brace = {"tip": Brace(arm.robot.hand[0], arm.robot.hand[1], UP, friction=0.0, min_N=0.0)}
    answer = arm.brace_statics(q, zeros, zeros, brace)
    gravity = arm.bias_forces(q, zeros)[0]
    lever = arm.point_jacobian(*arm.robot.hand, q)[2, 0]
    if gravity / lever > 0.0:  # the support can carry all of it
        assert answer.normal_forces["tip"] == pytest.approx(gravity / lever, rel=1e-8)
    assert np.isfinite(position).all()


def test_prepared_braces_are_those_of_the_call(arm):
    """What is kept from one call to the next is kept for the same objects alone, and these cannot change."""
    q, zeros = arm.robot.initial, np.zeros(arm.n)
    braces = elbows()
    first = arm.brace_statics(q, zeros, zeros, braces)
    braces["elbow_7"] = replace(braces["elbow_7"], normal_force=20.0)
    assert arm.brace_statics(q, zeros, zeros, braces).normal_forces["elbow_7"] == pytest.approx(20.0, abs=1e-12)
    fewer = arm.brace_statics(q, zeros, zeros, {"elbow_4": braces["elbow_4"]})
    assert list(fewer.forces) == ["elbow_4"]
    again = arm.brace_statics(q, zeros, zeros, elbows())
    assert np.array_equal(again.torques, first.torques)
    assert first.heat < fewer.heat
    with pytest.raises(ValueError, match="read-only"):
        braces["elbow_4"].normal[2] = -1.0


@settings(max_examples=20)
@given(seeds)
def test_a_motion_in_one_call_is_its_instants(arm, seed):
    """The compiled loop of planned voltages gives the torques of single states, and ends where there are none."""
    rng = np.random.default_rng(seed)
    model, _, _, _, braces = random_case(rng, arm, limited=True)
    q, v, vdot = rng.uniform(-2, 2, size=(6, model.n)), rng.normal(size=(6, model.n)), rng.normal(size=(6, model.n))
    attached = [model.robot.attach(brace.body, brace.point) for brace in braces.values()]
    planner = BracePlanner(model.robot, model.arrays, [link for link, _ in attached])
    points = np.array([point for _, point in attached])
    positions, velocities = planner.motion(points, q, v)
    for k, brace in enumerate(braces.values()):
        for t in range(6):
            position, jacobian = model.point_position_and_jacobian(brace.body, brace.point, q[t])
            assert positions[t, k] == pytest.approx(position, abs=1e-12)
            assert velocities[t, k] == pytest.approx(jacobian @ v[t], abs=1e-12)
    tables = np.stack(
        [
            brace_rows(
                points[k],
                np.tile(brace.normal, (6, 1)),
                np.full(6, brace.friction),
                brace.min_N,
                math.nan if brace.normal_force is None else brace.normal_force,
                np.tile(np.zeros(3) if brace.sliding is None else brace.sliding, (6, 1)),
            )
            for k, brace in enumerate(braces.values())
        ],
        axis=1,
    )
    torques, _, solved = planner.least_heat(q, v, vdot, tables)
    single = [model.brace_statics(q[t], v[t], vdot[t], braces) for t in range(6)]
    feasible = [answer.feasible for answer in single]
    assert solved == (feasible.index(False) if False in feasible else 6)
    for t in range(solved):
        assert torques[t] == pytest.approx(single[t].torques, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"normal_force": -1.0}, ["link_4", "normal_force -1.0"]),
        ({"normal": np.zeros(3)}, ["link_4", "normal"]),
        ({"friction": -0.1}, ["link_4", "friction -0.1"]),
        ({"min_N": math.nan}, ["link_4", "min_N nan"]),
        ({"sliding": UP}, ["link_4", "sliding", "[0.0, 0.0, 1.0]"]),
        ({"body": "link_99"}, ["link_99", "link_9"]),
        ({"point": np.zeros(2)}, ["point", "array([0., 0.])"]),
    ],
)
def test_refused(arm, changes, names):
    def ask():
        braces = {"elbow": replace(elbows()["elbow_4"], **changes)}
        return arm.brace_statics(arm.robot.initial, np.zeros(10), np.zeros(10), braces)

    with raises(ModelError, *names):
        ask()
