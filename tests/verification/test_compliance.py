"""Compliant contacts and ties in time stepping: closed forms, bounds and the ledger."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, lines_with, raises
from support.random_robots import CompiledSystem, assemble
from support.stepping_systems import plane, stepped

from dynsim import load_scenario, simulate
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.state import CONSTRAINT, DAMPED, FRICTION, STORED
from dynsim.engine.warnings import GAIN_LIMIT
from dynsim.errors import ModelError, ScenarioError
from dynsim.integrators.stepping.tables import CAPPED, WORST
from dynsim.model.description import Contact, Inertia, Link, Load, Robot, Tie, vector
from dynsim.model.joints.ball import floating
from dynsim.scenario import scenario_from_resolved

G, MASS, STIFFNESS, DAMPING = 9.81, 2.0, 2e4, 40.0
Z = vector(0, 0, 1)


def soft(stiffness: float = STIFFNESS, damping: float = DAMPING) -> CompiledSystem:
    """A mass on a vertical guide above a compliant floor."""
    link = Link("mass", "up", None, "prismatic", Z, Inertia(MASS))
    contact = Contact("foot", "mass", np.zeros(3), plane(Z), stiffness=stiffness, damping=damping)
    return assemble(Robot("mass", (link,), (), ("mass", np.zeros(3))), [contact], real=True)


def balance(run) -> np.ndarray:
    """Energy that the ledger does not explain at the samples [J], of a system without drives and loads."""
    energy, ledger = run.outputs("energy").sum(axis=1), run.states("ledger")
    lost = run.states("elastic").sum(axis=1) + run.states("scheme")[:, 0] + run.states("loss").sum(axis=1)
    return energy - energy[0] + lost + ledger[:, FRICTION] - ledger[:, CONSTRAINT]


@pytest.mark.parametrize("theta", [0.5, 1.0])
def test_a_mass_on_a_floor_that_gives_way_swings_and_decays_in_closed_form(theta):
    """x = −m g/k (1 − e^(−d t)(cos w t + d/w sin w t)) from the first touch at rest, as long as it presses."""
    b, decay = soft(), DAMPING / (2.0 * MASS)
    pulsation = np.sqrt(STIFFNESS / MASS - decay**2)
    times, errors = np.linspace(0.0, 0.5, 51), []
    swing = np.exp(-decay * times) * (np.cos(pulsation * times) + decay / pulsation * np.sin(pulsation * times))
    expected = -MASS * G / STIFFNESS * (1.0 - swing)
    for step in (1e-3, 5e-4):
        run = stepped(b, b.state(np.zeros(1), np.zeros(1)), times, step, theta)
        errors.append(np.abs(run.states("q")[:, 0] - expected).max() / (MASS * G / STIFFNESS))
        assert np.abs(balance(run)).max() < 1e-12
        stored, damped = run.states("elastic")[-1]
        if theta == 0.5:
            assert stored == pytest.approx(0.5 * STIFFNESS * run.states("q")[-1, 0] ** 2, rel=1e-9)
            assert run.states("scheme")[-1, 0] == pytest.approx(0.0, abs=1e-13)
            assert damped > 0.0
    assert errors[1] < (0.27 if theta == 0.5 else 0.55) * errors[0]
    assert errors[1] < (5e-3 if theta == 0.5 else 0.3)


def test_it_rests_as_deep_as_its_weight_presses():
    b = soft()
    run = stepped(b, b.state(np.zeros(1), np.zeros(1)), np.array([0.0, 4.0]), 1e-3, 0.5)
    assert run.states("q")[-1, 0] == pytest.approx(-MASS * G / STIFFNESS, rel=1e-9)
    assert run.outputs("contact")[-1, 0, 0] == pytest.approx(MASS * G, rel=1e-9)


def test_a_drop_is_caught_and_leaves_again():
    """m x'' = −k x − c x' − m g from touch at speed u on, until the force is zero: the floor never pulls."""
    b, height, decay = soft(damping=20.0), 0.05, 20.0 / (2.0 * MASS)
    pulsation, static_gap, u = np.sqrt(STIFFNESS / MASS - decay**2), -MASS * G / STIFFNESS, np.sqrt(2.0 * G * height)
    t = np.linspace(0.0, 0.05, 500001)
    e, c, s = np.exp(-decay * t), np.cos(pulsation * t), np.sin(pulsation * t)
    sine = (-u - decay * static_gap) / pulsation
    x, v = (
        static_gap + e * (-static_gap * c + sine * s),
        e * (-decay * (-static_gap * c + sine * s) + pulsation * (static_gap * s + sine * c)),
    )
    leaves = np.argmax((STIFFNESS * x + 20.0 * v >= 0.0) & (t > 0.01))
    top = x[leaves] + v[leaves] ** 2 / (2.0 * G)
    errors = []
    for step in (1e-3, 2.5e-4):
        run = stepped(b, b.state(np.array([height]), np.zeros(1)), np.arange(0.0, 0.3, 1e-3), step, 0.5)
        q = run.states("q")[:, 0]
        errors.append(abs(q[150:].max() - top))
        assert np.abs(balance(run)).max() < 1e-11
        assert run.outputs("contact")[:, 0, 0].min() >= 0.0
        assert run.states("elastic")[-1, STORED] == pytest.approx(0.0, abs=1e-13)
    assert errors[1] < 5e-4


def test_what_steps_do_not_resolve_is_as_rigid_contacts_are():
    """A million times the stiffness that a step of 1 ms resolves: no bounce, no ripple."""
    b = soft(stiffness=2e12)
    run = stepped(b, b.state(np.array([0.01]), np.zeros(1)), np.arange(0.0, 0.2, 1e-3), 1e-3, 0.5)
    force = run.outputs("contact")[100:, 0, 0]
    np.testing.assert_allclose(force, MASS * G, rtol=1e-6)
    assert abs(run.states("q")[-1, 0]) < 6e-4
    assert np.abs(balance(run)).max() < 1e-11


def test_four_feet_on_a_floor_that_gives_way_share_the_load():
    """Rigid feet leave the split open; soft ones have that of their deflections, and hold by friction on a slope."""
    body = Link("box", "root", None, "floating", Z, Inertia(4.0, vector(0.03, 0.01, 0.0), 0.02 * np.eye(3)))
    feet = [(x, y) for x in (-0.1, 0.1) for y in (-0.1, 0.1)]
    contacts = [
        Contact(f"foot_{k}", "box", vector(*foot, -0.1), plane(Z), friction=0.5, stiffness=STIFFNESS, damping=200.0)
        for k, foot in enumerate(feet)
    ]
    gravity = G * vector(0.2, 0.0, -1.0)
    b = assemble(Robot("box", tuple(floating(body)), (), ("box", np.zeros(3)), gravity=gravity), contacts, real=True)
    q = np.zeros(7)
    q[2], q[3] = 0.1, 1.0
    run = stepped(b, b.state(q, np.zeros(6)), np.array([0.0, 3.0]), 1e-3, 0.5)
    force = run.outputs("contact")[-1, :, 0]
    assert force.sum() == pytest.approx(4.0 * G, rel=1e-6)
    assert force[0] + force[3] == pytest.approx(force[1] + force[2], rel=1e-6)  # a plane carries them
    assert np.abs(run.states("v")[-1]).max() < 1e-9
    assert np.abs(balance(run)).max() < 1e-9
    # Feet that stick, and come nearer to each other as the box tilts, slip by 1e-5 m/s: the hardest of problems.
    assert run.stepping.statistics[WORST] < 1e-6


@pytest.mark.parametrize("slope", [0.2, 0.8])
def test_a_start_has_the_friction_that_it_needs_and_a_shorter_step_too(slope: float):
    """A mass pressed in as its weight presses: it rests where friction of 0.5 holds it, else slides in closed form.

    The last step is shorter by half: forces go on, not impulses.
    """
    body = Link("mass", "root", None, "floating", Z, Inertia(MASS, np.zeros(3), 1e-3 * np.eye(3)))
    contact = Contact("foot", "mass", np.zeros(3), plane(Z), friction=0.5, stiffness=STIFFNESS, damping=DAMPING)
    robot = Robot("mass", tuple(floating(body)), (), ("mass", np.zeros(3)), gravity=G * vector(slope, 0.0, -1.0))
    b, times, q = assemble(robot, [contact], real=True), np.array([0.0, 1e-3, 2e-3, 9e-3, 0.0105]), np.zeros(7)
    q[2], q[3] = -MASS * G / STIFFNESS, 1.0
    run = stepped(b, b.state(q, np.zeros(6)), times, 1e-3, 0.5)
    v, expected = run.states("v"), np.zeros((len(times), 6))
    expected[:, 0] = max(slope - 0.5, 0.0) * G * times
    np.testing.assert_allclose(v, expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(np.abs(balance(run)), 0.0, atol=1e-12)


def pair(ties: tuple[Tie, ...], *, mass: float = 1.0, loads: Sequence[Load] = ()) -> tuple[CompiledSystem, np.ndarray]:
    """Two free bodies without weight, each a tree of its own, 0.3 m apart along x."""
    links = []
    for name, own in (("one", mass), ("two", 3.0)):
        inertia = Inertia(own, np.zeros(3), own * np.diag([1e-3, 2e-3, 2.5e-3]))
        links += floating(Link(name, f"root_{name}", None, "floating", Z, inertia))
    robot = Robot("pair", tuple(links), (), ("two", np.zeros(3)), gravity=np.zeros(3), ties=ties)
    q = np.zeros(14)
    q[3], q[10], q[7] = 1.0, 1.0, 0.3
    return assemble(robot, loads=list(loads), real=True), q


def test_a_tie_between_two_trees_swings_with_their_reduced_mass():
    """x = x_0 e^(−d t)(cos w t + d/w sin w t) with 1/m = 1/m_1 + 1/m_2; momentum is kept."""
    stiffness, damping, mass, stretched = 300.0, 2.0, 0.75, 0.02
    tie = Tie("spring", "one", "two", vector(1, 0, 0), stiffness, damping, rest=-0.3 + stretched)
    times, decay, errors = np.linspace(0.0, 1.0, 21), damping / (2.0 * mass), []
    pulsation = np.sqrt(stiffness / mass - decay**2)
    expected = np.exp(-decay * times) * (np.cos(pulsation * times) + decay / pulsation * np.sin(pulsation * times))
    for step in (2e-3, 1e-3):
        b, q = pair((tie,))  # it knows what it has stored
        run = stepped(b, b.state(q, np.zeros(12)), times, step, 0.5)
        x = run.states("q")[:, 0] - run.states("q")[:, 7] - tie.rest
        errors.append(np.abs(x + stretched * expected).max() / stretched)
        v = run.states("v")
        assert np.abs(v[:, 0] + 3.0 * v[:, 6]).max() < 1e-12
        assert np.abs(balance(run)).max() < 1e-12
        # What a spring takes it has; with θ = 1/2 it is all in the ledger, and none of it an error of constraints.
        assert np.abs(run.states("scheme")).max() < 1e-12
        assert np.abs(run.states("ledger")[:, CONSTRAINT]).max() < 1e-12
    assert errors[1] < 0.26 * errors[0]
    assert errors[1] < 1e-3


def grip(force: float, moment: float) -> tuple[Tie, ...]:
    """Six ties: a hardened gripper of the first body about the centre of the second."""
    ends = {"point": vector(0.3, 0, 0), "body": "one", "other": "two"}
    axes = np.eye(3)
    return tuple(
        Tie(
            f"{'turn' if turns else 'push'}_{k}",
            axis=axes[k],
            stiffness=s,
            damping=c,
            bound=f,
            turns=turns,
            rest=np.nan,
            **ends,
        )
        for turns, s, c, f in ((False, 5e3, 100.0, force), (True, 20.0, 0.1, moment))
        for k in range(3)
    )


def test_six_ties_hold_a_body_as_one_and_slide_at_their_bounds():
    """A body that hangs from a heavy one is m g/k below it; heavier than the bound it sinks away with (m g − F)/m."""
    weight = Load("weight", "two", np.zeros(3), False, np.array([0.0, 100.0]), np.zeros((1, 6, 4)), True)
    weight.coefficients[0, 2, 0] = -3.0 * G
    for bound in (40.0, 20.0):
        b, q = pair(grip(bound, 50.0), mass=1e12, loads=[weight])
        times = np.array([0.0, 0.4, 2.0] if bound > 30.0 else [0.0, 0.2, 0.4])
        run = stepped(b, b.state(q, np.zeros(12)), times, 1e-3, 0.5)
        tie, down = b.system.unilateral.tie, -run.states("q")[:, 9]
        work = run.states("load")[:, 0]
        assert np.abs(balance(run) - work).max() < 1e-9
        assert run.stepping.statistics[CAPPED] == 0
        assert tie[2, ku.TIE_FORCE] == pytest.approx(-min(3.0 * G, bound), rel=1e-6)
        if bound > 3.0 * G:
            assert down[-1] == pytest.approx(3.0 * G / 5e3, rel=1e-4)
            assert tie[:, ku.TIE_GIVEN].max() == 0.0
        else:
            assert np.diff(run.states("v")[1:, 8])[0] == pytest.approx(-0.2 * (G - bound / 3.0), rel=1e-6)
            assert tie[2, ku.TIE_GIVEN] == pytest.approx(down[-1] - bound / 5e3, rel=1e-6)
            assert run.states("elastic")[-1, DAMPED] == pytest.approx(bound * down[-1], rel=0.05)


@pytest.mark.parametrize("swing", [0.0, 5.0, 12.0])
def test_a_tie_about_an_axis_swings_as_a_torsion_spring(swing: float):
    """The rotation vector, not its sine, and over several turns: large angles between two bodies."""
    stiffness, inertia, start = 0.2, 1.0 / (1.0 / 2.5e-3 + 1.0 / 7.5e-3), 0.8
    rate = np.sqrt(stiffness / inertia)
    b, q = pair((Tie("torsion", "one", "two", Z, stiffness, turns=True),))
    q[3], q[6] = np.cos(0.5 * start), np.sin(0.5 * start)
    v = np.zeros(12)
    v[5], v[11] = 0.75 * swing * rate, -0.25 * swing * rate
    times = np.linspace(0.0, 1.0, 401)
    run = stepped(b, b.state(q, v), times, 2.5e-4, 0.5)
    angles = [np.unwrap(2.0 * np.arctan2(run.states("q")[:, i + 6], run.states("q")[:, i + 3])) for i in (0, 7)]
    expected = start * np.cos(rate * times) + swing * np.sin(rate * times)
    np.testing.assert_allclose(angles[0] - angles[1], expected, atol=2e-3 * (1.0 + swing))
    assert np.abs(balance(run)).max() < 1e-9 * (1.0 + swing**2)


def test_a_tie_about_an_axis_keeps_energy_where_bodies_turn_about_others():
    """½ k x² with x along a rotation vector has a torque that is not along the axis; errors are of second order."""
    made = []
    for step in (1e-3, 5e-4):
        b, q = pair((Tie("torsion", "one", "two", Z, 0.2, turns=True),))
        v = np.zeros(12)
        v[3:6] = 4.0, -2.0, 6.0
        run = stepped(b, b.state(q, v), np.linspace(0.0, 0.6, 61), step, 0.5)
        turned = [2.0 * np.arccos(np.abs(run.states("q")[:, i])) for i in (3, 10)]
        assert max(turned[0].max(), turned[1].max()) > 1.5
        assert run.states("elastic")[:, STORED].max() > 0.01
        made.append(np.abs(run.states("scheme")).max())
        assert np.abs(balance(run)).max() < 1e-9
    assert made[1] < 0.3 * made[0] < 1e-4


def test_a_one_sided_tie_pushes_and_does_not_pull():
    """Two bodies collide by a spring and part: momentum, and energy without its damper."""
    tie = Tie("bumper", "two", "one", vector(1, 0, 0), 500.0, pushes=True, rest=0.2)
    b, q = pair((tie,))
    v = np.zeros(12)
    v[0] = 1.0
    run = stepped(b, b.state(q, v), np.array([0.0, 0.5]), 2.5e-4, 0.5)
    np.testing.assert_allclose(run.states("v")[-1, [0, 6]], [-0.5, 0.5], atol=2e-3)
    assert run.states("elastic")[-1, STORED] == pytest.approx(0.0, abs=1e-12)
    assert np.abs(balance(run)).max() < 1e-12


@pytest.mark.parametrize("damping", [1.0, 100.0])
def test_a_one_sided_tie_does_not_damp_before_it_touches(damping: float):
    """The gap of 0.1 m closes at 1 m/s; then the damper takes energy, and the momentum stays."""
    tie = Tie("bumper", "two", "one", vector(1, 0, 0), 500.0, damping, pushes=True, rest=0.2)
    b, q = pair((tie,))
    v = np.zeros(12)
    v[0] = 1.0
    run = stepped(b, b.state(q, v), np.array([0.0, 0.0995, 0.12, 1.0]), 2.5e-4, 0.5)
    before, during, after = run.states("v")[1:, [0, 6]]
    np.testing.assert_allclose(before, [1.0, 0.0], atol=1e-12)
    assert during[1] > 1e-3
    masses = np.array([1.0, 3.0])
    np.testing.assert_allclose(run.states("v")[:, [0, 6]] @ masses, 1.0, atol=1e-12)
    assert 0.0 < after[1] - after[0] < 1.0
    assert run.states("elastic")[-1, STORED] == pytest.approx(0.0, abs=1e-9)
    assert np.abs(balance(run)).max() < 1e-12


def test_a_tie_that_ends_loses_what_it_has_stored():
    """All of it goes to the damper, and the bodies go on as they are."""
    b, q = pair((Tie("spring", "one", "two", vector(1, 0, 0), 300.0, rest=-0.25),))
    b = b.with_shapes()
    run = b.new_run(b.state(q, np.zeros(12)), np.array([0.0, 0.1, 0.5]), "time_stepping", step=1e-3)
    b.advance(run, 101)
    b.system.unilateral.tie_table[0, ku.TIE_KIND] = -1
    b.finish(run)
    start, until, after = run.states("elastic")
    assert start[STORED] == 0.0 > until[STORED]
    assert after[STORED] == pytest.approx(-0.5 * 300.0 * 0.05**2, rel=1e-9)  # that of the start
    assert after[DAMPED] > 0.0
    assert np.abs(balance(run)).max() < 1e-12


SCENARIO = """
name: soft
duration_s: 0.5
plant:
  type: serial_arm
  chain: [{kind: prismatic, axis: z, length_m: 0, mass_kg: 2}]
surfaces: {floor: {type: plane}}
contacts:
  law: unilateral
  points: {foot: {body: link_1, stiffness_N_per_m: 20000, damping_N_s_per_m: 200}}
integrator: {method: time_stepping, step_s: 0.001}
"""


def test_scenarios_say_what_gives_way(tmp_path: Path):
    file = tmp_path / "soft.yaml"
    file.write_text(SCENARIO)
    record = simulate(load_scenario(file))
    assert record["contact_gap"][-1, 0] == pytest.approx(-2.0 * G / 2e4, rel=1e-3)
    assert record["energy_elastic"][-1] == pytest.approx(0.5 * 2e4 * record["contact_gap"][-1, 0] ** 2, rel=1e-6)
    assert record.summary["damper_loss_J"] == pytest.approx(record["loss_damper"][-1])
    assert record.summary["energy_residual_relative"] < 1e-9
    for key, value, names in (
        ("integrator.method", "radau5", ["stiffness_N_per_m = 20000", "integrator.method: time_stepping"]),
        ("contacts.points.foot.restitution", 0.5, ["contacts.points.foot.restitution = 0.5"]),
        ("contacts.points.foot.stiffness_N_per_m", None, ["damping_N_s_per_m = 200", "stiffness_N_per_m"]),
    ):
        with raises(ScenarioError, *names):
            load_scenario(file, overrides={key: value})


def test_ties_that_cannot_be_are_refused():
    for tie, names in (
        (Tie("t", "one", "two", Z, 0.0), ["t"]),
        (Tie("t", "one", "one", Z, 1.0), ["t", "one"]),
        (Tie("t", "one", "two", 0 * Z, 1.0), ["t"]),
        (Tie("t", "one", "three", Z, 1.0), ["three", "one, two"]),
    ):
        with raises(ModelError, *names):
            pair((tie,))


@pytest.mark.parametrize(("stiffness", "damping"), [(2e4, 20.0), (2e5, 63.0), (1e6, 141.0)])
def test_energy_that_steps_make_at_landings_is_warned_of_with_a_step_that_is_enough(stiffness: float, damping: float):
    """A step in which a spring is met has its force for none or all of it: up to z/4 of the energy that lands.

    z is h² k/m: 1 %, 10 % and 50 % here. The rest of a fall of several landings is lost before.
    """
    foot = {"body": "link_1", "stiffness_N_per_m": stiffness, "damping_N_s_per_m": damping}
    link = {"kind": "prismatic", "axis": "z", "length_m": 0, "mass_kg": MASS, "initial_m": 0.05}
    config = {
        "duration_s": 1.0,
        "plant": {"type": "serial_arm", "chain": [link]},
        "surfaces": {"floor": {"type": "plane"}},
        "contacts": {"law": "unilateral", "points": {"foot": foot}},
    }

    def drop(step: float):
        return simulate(scenario_from_resolved(config | {"integrator": {"method": "time_stepping", "step_s": step}}))

    record = drop(1e-3)
    (warning,) = lines_with(record.summary["warnings"], phrase="steps gain")
    made = record.summary["time_stepping"]["scheme_gain_J"]
    check_message(warning, f"{made:.3g} J", "integrator.step_s")
    turnover = record.summary["energy_turnover_J"]
    assert GAIN_LIMIT * turnover < made < 0.25 * turnover
    finer = drop(float(re.findall(r"\d[\d.]*(?:e-?\d+)?", warning)[-1]))
    assert finer.summary["time_stepping"]["scheme_gain_J"] <= GAIN_LIMIT * finer.summary["energy_turnover_J"]
    assert not lines_with(finer.summary["warnings"], phrase="steps gain")
