"""Integrators: order, tolerance, dense output, drift, energy ledger, runs in pieces; error estimate of RADAU5."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.random_robots import ADAPTIVE, CompiledSystem, assemble

from dynsim.dynamics.state import CONSTRAINT, ELECTRICAL, FRICTION, GEAR, JOINT, JOULE, OUT_GAP
from dynsim.integrators.methods import METHODS, by_number
from dynsim.integrators.radau5.step import (
    SHORT,
    collocation_error,
    energy_error,
    estimate,
    guess_stages,
    keep_stages,
    slack,
    step_radau5,
)
from dynsim.integrators.radau5.tables import ERROR_RADAU, GAMMA_RADAU, ITERATIONS, NODE_RADAU
from dynsim.integrators.run import (
    DRIFT_MAX,
    EVALUATIONS,
    FINISHED,
    PROJECTIONS,
    REJECTED,
    STATUS,
    STEP,
    STEP_MAX,
    STEPS,
    Run,
)
from dynsim.model.description import Contact, Inertia, Link, Quadric, Robot
from dynsim.model.drives import Motor

Y, Z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def arm(inductance: float = 1.7e-3, *, braced: bool = False, v_s: float = 0.05) -> tuple[CompiledSystem, np.ndarray]:
    """A yawing four-link arm with motors; braced: its second elbow slides on the floor. Smooth: large v_s."""
    angles = np.array([0.3, 0.5 * np.pi - 0.4, 0.8, -1.1, 0.7])
    links, length = [], 0.3
    for i in range(5):
        links.append(
            Link(
                f"b{i}",
                f"j{i}",
                None if i == 0 else f"b{i - 1}",
                "revolute",
                Z if i == 0 else Y,
                Inertia.solid_cylinder(0.2, 0.02, length),
                p_PJ=np.zeros(3) if i < 2 else np.array([0.0, 0.0, length]),
                damping=0.1,
            )
        )
    motors = tuple(Motor(f"j{i}", 0.2, 1.1, inductance, 1.6e-4, 3.0, 0.01) for i in range(5))
    robot = Robot("arm", tuple(links), motors, ("b4", np.array([0.0, 0.0, length])))
    # The floor is put under the end of link 2, where it is at the start.
    contacts = []
    if braced:
        height = length * (np.cos(angles[1]) + np.cos(angles[1] + angles[2]))
        floor = Quadric(np.zeros((3, 3)), Z, -height)
        # Signed friction is smooth; μ |f_n| has a kink where the floor begins to pull, and no order there.
        elbow = Contact("elbow", "b2", np.array([0.0, 0.0, length]), floor, friction=0.1, slip_smoothing=v_s)
        contacts = [replace(elbow, pulling_friction="signed")]
    b = assemble(robot, contacts, held=angles + np.array([0.3, 0.1, -0.2, 0.2, 0.3]), k_p=40.0, k_d=1.0)
    return b, b.state(angles, np.zeros(5))


def motion(run: Run) -> np.ndarray:
    """q and v of the samples, (T, 2 n)."""
    return np.hstack([run.states("q"), run.states("v")])


def errors(b: CompiledSystem, y: np.ndarray, method: str, steps: list[float], times: np.ndarray) -> np.ndarray:
    """Largest error of q, v at ``times`` for each step."""
    reference = motion(b.simulate(y, times, "dopri5", rtol=1e-12))
    return np.array([np.abs(motion(b.simulate(y, times, method, step=h, fixed=True)) - reference).max() for h in steps])


def slopes(values: np.ndarray) -> np.ndarray:
    return np.log2(values[:-1] / values[1:])


# Steps [s] in the range where errors are asymptotic and above rounding; for samples also the order of dense output.
STEPS_OF_ORDER = {
    "dopri5": [8e-4, 4e-4, 2e-4],
    "radau5": [2e-3, 1e-3, 5e-4],
    "bogacki_shampine": [4e-4, 2e-4, 1e-4],
}
STEPS_OF_SAMPLES = {
    "dopri5": (4, [8e-4, 4e-4]),
    "radau5": (3, [4e-3, 2e-3]),
    "bogacki_shampine": (3, [4e-4, 2e-4]),
}


@pytest.mark.parametrize(
    ("method", "order", "steps"),
    [(method.name, method.order, STEPS_OF_ORDER[method.name]) for method in METHODS.values() if method.adaptive],
)
@pytest.mark.parametrize("braced", [False, True])
def test_order_by_halving_the_step(method, order, steps, braced):
    b, y = arm(braced=braced)
    orders = slopes(errors(b, y, method, steps, np.array([0.08])))
    # Asymptotic only as h → 0, and single errors may pass through zero: the mean slope, with half an order of slack.
    assert orders.mean() >= order - 0.5, orders


def test_radau5_is_of_its_stage_order_at_least_when_the_inductance_vanishes():
    """L = 1e-8 H: electrical pole 1e8 1/s, a hundred thousand times beyond what an explicit method could follow.

    From the current that the voltage drives through R: the layer in which any other current decays is a motion of its
    own, which steps of this size pass over (and then with order 3).
    """
    b, y = arm(inductance=1e-8)
    b.part(y, "current")[:] = 40.0 * (b.system.reference.held - b.part(y, "q")) / 1.1
    times = np.array([0.08])
    runs = [motion(b.simulate(y, times, "radau5", step=h, fixed=True)) for h in (4e-3, 2e-3, 1e-3, 1e-4)]
    orders = slopes(np.array([np.abs(r - runs[-1]).max() for r in runs[:-1]]))
    assert orders.min() >= 3.5, orders


@pytest.mark.parametrize(
    ("method", "order", "steps"),
    [(name, *STEPS_OF_SAMPLES[name]) for name, method in METHODS.items() if method.adaptive],
)
def test_order_of_the_dense_output(method, order, steps):
    """Between the steps: local order 4 of dopri5, 3 of radau5 and bogacki_shampine (errors of order + 1 locally)."""
    b, y = arm()
    # Fractions of the largest step that are no grid points of either.
    times = steps[0] * (np.arange(40, 100) + 0.37)
    orders = slopes(errors(b, y, method, steps, times))
    assert orders.min() >= order - 0.5, orders


def test_methods_have_different_numbers_and_unknown_numbers_are_errors():
    assert len({method.number for method in METHODS.values()}) == len(METHODS)
    with pytest.raises(ValueError, match="99"):
        by_number(99)


@pytest.mark.parametrize("method", ADAPTIVE)
@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8])
def test_adaptive_runs_meet_their_tolerance(method, rtol):
    b, y = arm(braced=True)
    times = np.linspace(0.05, 0.5, 10)
    reference, run = b.simulate(y, times, rtol=1e-12), b.simulate(y, times, method, rtol=rtol)
    # Local control: the sum of all local errors, damped by the motors, stays within 20 tolerances of unit-sized states.
    assert np.abs(run.states("q") - reference.states("q")).max() <= 20.0 * rtol
    expected, computed = (np.hstack([r.states("v"), r.states("current")]) for r in (reference, run))
    assert np.abs(computed - expected).max() <= 20.0 * rtol * np.abs(expected).max()


def double_pendulum() -> CompiledSystem:
    """Two point masses on rods of 1 m, without motors and losses: nothing damps an error."""
    links = [
        Link(
            f"b{i}",
            f"j{i}",
            None if i == 0 else "b0",
            "revolute",
            Y,
            Inertia(1.0, -Z),
            p_PJ=np.zeros(3) if i == 0 else -Z,
        )
        for i in range(2)
    ]
    return assemble(Robot("double pendulum", tuple(links), (), ("b1", -Z)))


@pytest.mark.parametrize("method", ADAPTIVE)
@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8, 1e-10])
def test_where_accuracy_sets_the_step_the_error_is_about_the_tolerance(method, rtol):
    """Measured: dopri5 0.2 to 1.0, radau5 0.01 to 0.05."""
    b, times = double_pendulum(), np.array([1.0, 1.5, 2.0])
    y = b.state([0.5, 0.5], [0.0, 0.0])
    error = b.simulate(y, times, method, rtol=rtol).states("q") - b.simulate(y, times, rtol=1e-13).states("q")
    assert 1e-3 * rtol < np.abs(error).max() <= 2.0 * rtol


@pytest.mark.parametrize("method", ADAPTIVE)
def test_passive_chaos_keeps_its_energy(method):
    """10 s of tumbling, per m g l of both rods. Measured in rtol: dopri5 5.0, radau5 0.4."""
    b, rtol = double_pendulum(), 1e-6
    run = b.simulate(b.state([1.5, 0.5], [0.0, 0.0]), np.linspace(0.0, 10.0, 101), method, rtol=rtol)
    energies = run.outputs("energy").sum(axis=1)
    assert 0.0 < np.abs(energies - energies[0]).max() / (3.0 * 9.81) <= 8.0 * rtol


def test_explicit_steps_at_the_stability_limit_are_hardly_ever_rejected():
    b, y = arm(braced=True)
    run = b.simulate(y, np.array([3.0]), rtol=1e-4)
    assert run.count[STEPS] > 500
    assert run.count[REJECTED] <= 0.02 * run.count[STEPS]


@pytest.mark.parametrize("method", ADAPTIVE)
def test_contacts_do_not_drift(method):
    b, y = arm(braced=True, v_s=1e-3)
    run = b.simulate(y, np.linspace(0.0, 2.0, 41), method)
    # The promise; rounding is left, so zero would be a column that nobody writes.
    assert 0.0 < run.extremes[0, DRIFT_MAX] <= 1e-9
    assert 0.0 < np.abs(run.outputs("contact")[:, :, OUT_GAP]).max() <= 1e-9


def ledger_residual(run: Run) -> float:
    """Everything that went in minus everything that came out or is stored, over the turnover."""
    stored, ledger = run.outputs("energy").sum(axis=1), run.states("ledger")[-1]
    spent = ledger[[JOULE, GEAR, JOINT, FRICTION]]
    residual = ledger[ELECTRICAL] + ledger[CONSTRAINT] - spent.sum() - (stored[-1] - stored[0])
    return residual / (abs(ledger[ELECTRICAL]) + spent.sum())


@pytest.mark.parametrize("braced", [False, True])
def test_energy_ledger_closes(braced):
    b, y = arm(braced=braced)
    times = np.array([0.0, 1.0])
    # The promise is 1e-6 at default settings; integrated at the order of the method it closes far better.
    for method, close, closer in (("dopri5", 1e-8, 1e-11), ("radau5", 1e-7, 1e-11)):
        assert 0.0 < abs(ledger_residual(b.simulate(y, times, method))) <= close
        assert 0.0 < abs(ledger_residual(b.simulate(y, times, method, rtol=1e-10))) <= closer


def test_energy_ledger_closes_at_the_order_of_the_method():
    b, y = arm()
    times = np.array([0.0, 0.2])
    runs = [b.simulate(y, times, "dopri5", step=h, fixed=True) for h in (8e-4, 4e-4, 2e-4)]
    orders = slopes(np.array([abs(ledger_residual(run)) for run in runs]))
    assert orders.min() >= 4.5, orders


@pytest.mark.parametrize("method", ADAPTIVE)
def test_a_run_in_pieces_is_the_same_run(method):
    b, y = arm(braced=True)
    whole = b.simulate(y, np.array([0.3]), method)
    run = b.new_run(y, np.array([0.3]), method)
    while run.count[STATUS] != FINISHED:
        b.advance(run, 7)
    np.testing.assert_array_equal(run.y, whole.y)


def test_what_collocation_misses():
    """Of y' = t³ the collocation polynomial is y less ∫ Π (s − c_i) ds; the error estimate is −1/(10 γ) of h⁴ y⁗/6."""
    c = NODE_RADAU
    product = np.poly1d(c, r=True)
    slope = np.poly1d([1.0, 0.0, 0.0, 0.0]) - product  # interpolates t³ at the nodes
    collocation, exact = slope.integ(), np.poly1d([0.25, 0.0, 0.0, 0.0, 0.0])
    for x in np.linspace(0.0, 2.5, 26):
        assert collocation_error(x) == pytest.approx(exact(x) - collocation(x), abs=1e-14)
    estimate = ERROR_RADAU @ collocation(c) / GAMMA_RADAU
    assert estimate == pytest.approx(-1.0 / (10.0 * GAMMA_RADAU), rel=1e-12)


@pytest.mark.parametrize("ratio", [0.5, 1.0, 1.6])
@pytest.mark.parametrize("braced", [False, True])
def test_the_first_guess_is_right_but_for_the_fifth_power_of_the_step(ratio, braced):
    b, y = arm(braced=braced)
    errors_of_guess = []
    for h in (1e-3, 5e-4, 2.5e-4):
        run = b.new_run(y, np.array([1.0]), "radau5", step=h, fixed=True)
        b.advance(run, int(0.02 / h))
        keep_stages(run)
        guess_stages(run, ratio * h)
        guess = run.newton.z[:, : run.newton.kept.shape[1]].copy()
        run.clock[STEP] = run.clock[STEP_MAX] = ratio * h
        b.advance(run, 1)
        solved = run.newton.z[:, : guess.shape[1]]
        errors_of_guess.append(np.abs(guess - solved).max() / np.abs(solved).max() * h)
    orders = np.log2(np.array(errors_of_guess[:-1]) / errors_of_guess[1:])
    # Without the error of the last step they are right but for the fourth.
    assert orders.min() >= 4.6, (errors_of_guess, orders)


def test_a_step_that_would_be_rejected_is_judged_by_the_error_from_where_it_leads():
    """(γ/h − J)⁻¹ (f(y + e) + Σ e_s Z_s / h) with e the first estimate, which says too much of what decays."""
    b, y = arm()
    h = 2e-2  # ten times what currents take
    run = b.advance(b.new_run(y, np.array([1.0]), "radau5", step=h), 0)
    error = step_radau5(b.system, b.ws, run)
    first = estimate(b.system, b.ws, run, h, run.stage[0])
    slope = b.derivative(y + run.stage[7])
    second = estimate(b.system, b.ws, run, h, slope)
    assert energy_error(b.system, run, h) < second < 0.2 * first
    assert error == pytest.approx(second, rel=1e-9)


def test_every_evaluation_is_counted():
    """Six of a step of dopri5, one of a sample, one of the start; and one after each projection."""
    b, y = arm()
    run = b.simulate(y, np.linspace(1e-3, 5e-3, 3), "dopri5", step=1e-3, fixed=True)
    assert run.count[STEPS] == 5
    assert run.count[EVALUATIONS] == 6 * 5 + 3 + 1
    b, y = arm(braced=True)
    b.part(y, "q")[1] += 1e-4
    run = b.advance(b.new_run(y, np.array([1.0]), "dopri5"), 0)
    assert run.count[PROJECTIONS] >= 1
    assert run.count[EVALUATIONS] == 1 + run.count[PROJECTIONS]


def test_most_steps_take_one_iteration():
    """Where the motion is smooth: 1.2, and 1.6 without the error of the last step."""
    b, y = arm()
    run = b.simulate(y, np.array([0.5]), "radau5")
    assert run.newton.count[ITERATIONS] <= 1.4 * run.count[STEPS]


def test_slack_of_short_steps():
    """Rates may be off by what moves a joint as far as atol does in a step of 5 ms, where motors damp them."""
    driven, _ = arm()
    steps = (2.0 * SHORT, SHORT, 0.1 * SHORT, 1e-3 * SHORT)
    assert [slack(driven.system, h, 1e-6) for h in steps] == pytest.approx([1.0, 1.0, 10.0, 1000.0])
    assert [slack(driven.system, h, 1e-7) for h in steps] == pytest.approx([1.0, 1.0, 1.0, 10.0])
    assert [slack(driven.system, h, 1e-8) for h in steps] == [1.0] * 4
    assert slack(driven.system, 0.1 * SHORT, 1e-3) == pytest.approx(10.0)
    free = assemble(replace(driven.robot, motors=()))
    assert slack(free.system, 0.1 * SHORT, 1e-6) == 1.0
