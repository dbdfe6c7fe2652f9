"""Static friction above the kinetic one: stick–slip in closed form, the direction in which slip begins, named stops."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq
from support.messages import check_message, raises
from support.random_robots import CompiledSystem, assemble
from support.unilateral_checks import events, random_touch, violations

import dynsim
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.state import OUT_VECTOR
from dynsim.engine.force_indeterminacy import paradox
from dynsim.errors import SimulationStopped
from dynsim.integrators import run as ki
from dynsim.integrators.contacts import events as ke
from dynsim.model.description import Contact, Inertia, Link, Load, Quadric, Robot
from dynsim.model.drives import Servo

G, MASS, CART = 9.81, 2.0, 4.0
STATIC, KINETIC = 0.6, 0.4
FLOOR = Quadric(np.zeros((3, 3)), np.array([0.0, 0.0, 1.0]), 0.0)


def pull(body: str, wrench: np.ndarray, rate: np.ndarray) -> Load:
    """Force and moment, (6,), that grow at ``rate``."""
    powers = np.zeros((1, 6, 4))
    powers[0, :, 0], powers[0, :, 1] = wrench, rate
    return Load("pull", body, np.zeros(3), False, np.array([0.0, 20.0]), powers, True)


def foot(body: str, point: np.ndarray) -> Contact:
    return Contact("foot", body, point, FLOOR, friction=KINETIC, static_friction=STATIC, pulling_friction="signed")


def sledge(force: np.ndarray, rate: np.ndarray, cart: float = CART) -> CompiledSystem:
    """A block on the floor under a pull F + F' t; along x it takes a cart with it that runs on rails."""
    links = tuple(
        Link(name, f"joint_{name}", "wxyz"[k] if k else None, "prismatic", np.eye(3)[k], Inertia(mass))
        for k, (name, mass) in enumerate({"x": cart, "y": 0.0, "z": MASS}.items())
    )
    none = np.zeros(3)
    load = pull("z", np.append(force, none), np.append(rate, none))
    return assemble(Robot("sledge", links, (), ("z", none)), [foot("z", none)], loads=[load], real=True)


def whisk(stiffness: float, speed: float) -> CompiledSystem:
    """A block on the floor at the end of a bar of 1 m, turned about the vertical through a spring whose end moves."""
    end = np.array([1.0, 0.0, 0.0])
    links = (
        Link("lift", "rail", None, "prismatic", np.array([0.0, 0.0, 1.0]), Inertia(0.0)),
        Link("bar", "hinge", "lift", "revolute", np.array([0.0, 0.0, 1.0]), Inertia(MASS, end)),
    )
    # A servo with almost no back-EMF is a spring to its initial angle; the moment is the effect of moving its end.
    spring = Servo("hinge", torque_constant=1e-6, resistance=1.0, k_p=1e6 * stiffness)
    moment = pull("bar", np.zeros(6), np.append(np.zeros(5), stiffness * speed))
    return assemble(Robot("whisk", links, (spring,), ("bar", end)), [foot("bar", end)], loads=[moment], real=True)


def test_a_block_dragged_through_a_spring_sticks_and_slips():
    """Spring k, its end drawn at V: it sticks for 2 A/V and slips for 2 (π − atan(A ω/V))/ω, A = (μ_s − μ_k) N/k."""
    stiffness, speed = 200.0, 0.1
    b = whisk(stiffness, speed)
    omega, swing = np.sqrt(stiffness / MASS), (STATIC - KINETIC) * MASS * G / stiffness
    stick = 2.0 * swing / speed
    slip = 2.0 / omega * (np.pi - np.arctan(swing * omega / speed))
    first = STATIC * MASS * G / (stiffness * speed)
    run = b.simulate(b.state(np.zeros(2), np.zeros(2)), np.linspace(0.0, 3.6, 3601), rtol=1e-10)
    happened = events(run)
    assert [kind for _, _, kind in happened] == [ke.SLIP_START, ke.SLIP_STOP] * (len(happened) // 2)
    assert len(happened) >= 8
    cycle = np.arange(len(happened) // 2)
    times = np.array([t for t, _, _ in happened]).reshape(-1, 2)
    np.testing.assert_allclose(times[:, 0], first + cycle * (stick + slip), rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(times[:, 1], times[:, 0] + slip, rtol=0.0, atol=1e-7)
    # While it rests, the spring is as long as it was about to slip, less 2 A.
    x = run.states("q")[:, 1]
    rests = speed * times[:, 1] - (KINETIC * MASS * G / stiffness - swing)
    for k in range(3):
        still = (run.sample_time > times[k, 1]) & (run.sample_time < times[k + 1, 0])
        np.testing.assert_allclose(x[still], rests[k], rtol=0.0, atol=1e-8)
    stretched = speed * run.sample_time - x
    amplitude = np.hypot(swing, speed / omega)
    middle = KINETIC * MASS * G / stiffness
    later = run.sample_time > times[0, 0]
    np.testing.assert_allclose(
        [stretched[later].max(), stretched[later].min()], [middle + amplitude, middle - amplitude], rtol=0.0, atol=1e-6
    )


@pytest.mark.parametrize("grows", [False, True])
def test_slip_begins_in_the_direction_of_kinetic_friction(grows):
    """Heavier along x than along y: the acceleration (F − μ_k N t)/M is along t, not along the pull."""
    direction = np.array([np.cos(0.8), np.sin(0.8), 0.0])
    least = STATIC * MASS * G * direction
    b = sledge(np.zeros(3), 2.0 * least) if grows else sledge(1.2 * least, np.zeros(3))
    onset = 0.5 if grows else 0.0
    force, friction = (least if grows else 1.2 * least), KINETIC * MASS * G

    def across(angle: float) -> float:
        x = (force[0] - friction * np.cos(angle)) / (MASS + CART)
        y = (force[1] - friction * np.sin(angle)) / MASS
        return float(x * np.sin(angle) - y * np.cos(angle))

    angle = brentq(across, 0.8, 0.5 * np.pi, xtol=1e-14)
    times = np.array([0.0, onset + 1e-9, onset + 0.1])
    run = b.simulate(b.state(np.zeros(3), np.zeros(3)), times, rtol=1e-10)
    assert angle - 0.8 > 0.1
    held = run.outputs("contact")[1, 0, OUT_VECTOR : OUT_VECTOR + 2]
    np.testing.assert_allclose(held, -friction * np.array([np.cos(angle), np.sin(angle)]), rtol=0.0, atol=1e-6)
    if not grows:
        x = 0.5 * 0.1**2 * (force[0] - friction * np.cos(angle)) / (MASS + CART)
        np.testing.assert_allclose(run.states("q")[2, :2], [x, x * np.tan(angle)], rtol=1e-7)


@pytest.mark.parametrize("grows", [False, True])
@pytest.mark.parametrize("cart", [2e7, 1e9, 5e9])
def test_a_block_that_hardly_accelerates_slips_where_its_static_friction_is_exceeded(cart, grows):
    """a = (F − μ_k N)/(M + cart), which is almost zero compared with g: forces show the slip, not accelerations."""
    along, least = np.array([1.0, 0.0, 0.0]), STATIC * MASS * G
    force, rate, excess, onset = (0.0, 2.0 * least, 0.0, 0.5) if grows else (least + 1.0, 0.0, 1.0, 0.0)
    b = sledge(force * along, rate * along, cart)
    run = b.simulate(b.state(np.zeros(3), np.zeros(3)), np.linspace(0.0, onset + 1.0, 4), rtol=1e-10)
    assert [kind for _, _, kind in events(run)] == ([ke.SLIP_START] if grows else [])
    held = run.outputs("contact")[-1, 0, OUT_VECTOR]
    assert held == pytest.approx(-KINETIC * MASS * G, abs=1e-6)
    x = (0.5 * ((STATIC - KINETIC) * MASS * G + excess) + rate / 6.0) / (MASS + cart)
    assert run.states("q")[-1, 0] == pytest.approx(x, rel=1e-6)


@pytest.mark.parametrize("seed", [23, 92, 472, 556])
def test_what_went_on_without_end_goes_on(seed):
    """Points that crept in the wrong direction, touched without a force, or threw each other back and forth."""
    b, y = random_touch(seed)
    run = b.advance(b.new_run(y, np.linspace(0.0, 1.0, 51), "dopri5", rtol=1e-8), 5_000)
    assert run.count[ki.STATUS] == ki.FINISHED
    for rule, size in violations(b, run).items():
        assert size <= 1e-7, (rule, size)


ROD = """
duration_s: 0.5
plant:
  type: serial_arm
  gravity_m_s2: [-40, 0, -9.81]
  chain:
    - {kind: prismatic, axis: x, mass_kg: 0, length_m: 0}
    - {kind: prismatic, axis: z, mass_kg: 0, length_m: 0, initial_m: 0.41266780745}
    - {axis: y, mass_kg: 1, length_m: 0, com_m: [0, 0, 0], initial_deg: 34.37746770784939,
       inertia_kg_m2: [0.0833333, 0, 0, 0.0833333, 0, 0.0833333]}
surfaces: {floor: {type: plane}}
contacts:
  law: unilateral
  friction: 2
  points: {tip: {body: link_3, point_m: [0, 0, -0.5]}}
"""


def test_the_paradox_names_contact_time_and_state(tmp_path: Path):
    """A rod is flung over its foot, which begins to slip where 1 + 3 s (s − μ c) < 0: less friction avoids this."""
    path = tmp_path / "rod.yaml"
    path.write_text(ROD)
    with raises(SimulationStopped, "Painlevé", "tip", "det J M⁻¹F", re.compile(r"\(-0\.\d")) as stop:
        dynsim.simulate(dynsim.load_scenario(str(path)))
    error = stop.value
    assert error.record.time[-1] <= error.time < error.record.time[-1] + 0.01
    _, height, lean = error.state["q"]
    assert height == pytest.approx(0.5 * np.cos(lean), abs=1e-9)
    critical = (1.0 + 3.0 * np.sin(lean) ** 2) / (3.0 * np.sin(lean) * np.cos(lean))
    assert critical < 2.0
    check_message(error, f"{error.time:.6g} s", "contacts.friction", f"{critical:.3g}")
    stopped = error.record.provenance["stopped"]
    assert (stopped["time_s"], stopped["reason"]) == (error.time, str(error))
    assert stopped["state"] == error.state


def test_a_stop_at_an_event_names_the_contacts_that_touch():
    """A run that stops at an event is in the paradox at the time that it has reached, with the modes chosen there."""
    b, y = random_touch(1226)
    run = b.advance(b.new_run(y, np.linspace(0.0, 1.0, 51), "dopri5", rtol=1e-8), 5_000)
    assert run.count[ki.STATUS] == ki.FORCES_REVERSED
    t, _, words = paradox(b.system, b.ws, run, b.contacts)
    assert t == run.clock[ki.TIME]
    check_message(words, "Painlevé", "contact_0")


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_a_point_that_rows_of_others_stop_keeps_its_direction_of_slip(method: str) -> None:
    """A plate turns so slowly about one foot that the next one rests too: both stop the far foot, which still slips."""
    kinds = [
        ("prismatic", (1.0, 0.0, 0.0)),
        ("prismatic", (0.0, 1.0, 0.0)),
        ("prismatic", (0.0, 0.0, 1.0)),
        ("revolute", (0.0, 0.0, 1.0)),
    ]
    names = ["x", "y", "z", "plate"]
    links = tuple(
        Link(name, f"to_{name}", names[k - 1] if k else None, kind, np.array(axis), Inertia(1.0, tensor=np.eye(3)))
        for k, (name, (kind, axis)) in enumerate(zip(names, kinds, strict=True))
    )
    feet = [
        Contact(name, "plate", np.array([x, 0.0, 0.0]), FLOOR, friction=0.3)
        for name, x in (("still", 0.0), ("near", 0.1), ("far", 1.0))
    ]
    slow = 1e-5
    b = assemble(Robot("plate", links, (), ("plate", np.zeros(3))), feet, real=True, slow=slow)
    y = b.state(np.zeros(4), np.array([0.0, 0.0, 0.0, 15.0 * slow]))
    run = b.advance(b.new_run(y, np.array([0.1]), method), 0)
    slide = b.system.unilateral.slide
    assert b.ws.active[2, ka.MODE] == ka.SLIDING
    assert np.abs(b.ws.joints[:, ka.QD]).max() < 1e-15
    assert slide[2, ku.FROZEN] == 1.0
    np.testing.assert_allclose(slide[2, ku.REFERENCE : ku.REFERENCE + 3], [0.0, 1.0, 0.0], rtol=0, atol=1e-12)
    # Its friction would turn the plate back; so all feet rest at once.
    run = b.advance(run)
    assert run.count[ki.STATUS] == ki.FINISHED
    assert b.ws.active[:3, ka.MODE].tolist() == [ka.STICKING] * 3
    assert np.abs(run.states("q")[-1]).max() < 1e-9


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_friction_of_slow_slip_turns_with_the_forces(method: str) -> None:
    """A block creeps along x against damping D, slower than slip has a direction, while a force F along y grows.

    Friction balances F, so it turns by asin(F / μ N), and v_x = (F_x − √((μ N)² − F²)) / D. A direction that does not
    turn leaves F to drive the block along y, past the limit within 0.1 ms, over and over again.
    """
    slow, speed, damping, friction, pull_time = 1e-5, 3e-6, 2e5, KINETIC * MASS * G, 0.1
    links = tuple(
        Link(
            name,
            f"joint_{name}",
            "wxyz"[k] if k else None,
            "prismatic",
            np.eye(3)[k],
            Inertia(MASS if k == 2 else 0.0),
            damping=damping if k == 0 else 0.0,
        )
        for k, name in enumerate("xyz")
    )
    none = np.zeros(3)
    load = pull(
        "z",
        np.array([friction + damping * speed, 0.0, 0.0, 0.0, 0.0, 0.0]),
        np.array([0.0, 0.6 * friction / pull_time, 0.0, 0.0, 0.0, 0.0]),
    )
    touch = Contact("foot", "z", none, FLOOR, friction=KINETIC)
    b = assemble(Robot("block", links, (), ("z", none)), [touch], loads=[load], real=True, slow=slow)
    times = np.linspace(0.0, pull_time, 21)
    run = b.simulate(b.state(none, np.array([speed, 0.0, 0.0])), times, method)
    assert events(run) == []
    # Stable explicit steps are at most 3.3 times the time constant of the direction, m s / (μ N).
    stable = 3.3 * MASS * slow / friction
    assert run.count[ki.STEPS] < (200 if method == "radau5" else 2.0 * pull_time / stable)
    sideways = 0.6 * friction * times / pull_time
    along = np.sqrt(friction**2 - sideways**2)
    held = run.outputs("contact")[1:, 0, OUT_VECTOR : OUT_VECTOR + 2]
    np.testing.assert_allclose(held, -np.transpose([along, sideways])[1:], rtol=0.0, atol=2e-3 * friction)
    v = run.states("v")[1:]
    np.testing.assert_allclose(v[:, 0], speed + (friction - along[1:]) / damping, rtol=0.0, atol=0.01 * slow)
    # Slip across the direction that was taken last is slower than TURNED times the limit.
    assert np.abs(v[:, 1] - v[:, 0] * (sideways / along)[1:]).max() < ke.TURNED * slow
