"""Real contact: an arm's elbow against equations derived by hand, a rod that falls flat, an hour of rest, a paradox."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.random_robots import CompiledSystem, assemble
from support.unilateral_checks import events, ledger_residual

from dynsim.dynamics import tables as ka
from dynsim.dynamics.state import OUT_FORCE, OUT_GAP, OUT_MODE, OUT_VECTOR
from dynsim.integrators import run as ki
from dynsim.integrators.contacts import events as ke
from dynsim.integrators.run import GAP_TOLERANCE
from dynsim.model.description import Contact, Inertia, Link, Quadric, Robot, vector

G = 9.81
X, Y, Z = np.eye(3)
TIGHT = {"rtol": 1e-11, "atol": 1e-13}


def plane(normal: np.ndarray) -> Quadric:
    return Quadric(np.zeros((3, 3)), normal, 0.0)


def touching(body: str, point: np.ndarray, normal: np.ndarray = Z, **law: float) -> Contact:
    return Contact(f"{body} {point}", body, point, plane(normal), pulling_friction="signed", **law)


# A cart m on a rail at the height of the elbow's floor plus L cos A, a rod m1 (centre at half its length L) down to the
# elbow, a rod m2 (centre at distance C of the elbow, moment J about its centre) that swings from there.
M0, M1, M2, L, A, C, J = 1.5, 0.8, 0.5, 0.4, 0.5, 0.15, 0.004
MU, STATIC = 0.25, 0.3
J1 = M1 * L**2 / 12.0


def arm() -> CompiledSystem:
    links = (
        Link("cart", "rail", None, "prismatic", X, Inertia(M0)),
        Link("upper", "shoulder", "cart", "revolute", -Y, Inertia(M1, -0.5 * L * Z, np.diag([J1, J1, 0.0]))),
        Link("fore", "elbow", "upper", "revolute", -Y, Inertia(M2, -C * Z, np.diag([J, J, 0.0])), p_PJ=-L * Z),
    )
    links = (Link(**{**links[0].__dict__, "p_PJ": L * np.cos(A) * Z}), *links[1:])
    robot = Robot("arm", links, (), ("fore", -2.0 * C * Z))
    return assemble(robot, [touching("upper", -L * Z, friction=MU, static_friction=STATIC)], real=True)


def arm_equations(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """M(q) and h of M q̈ = h for q = x, α, β: both angles from the vertical, to +x; from Lagrange's equations."""
    a, b, va, vb = s[1], s[2], s[4], s[5]
    m = M0 + M1 + M2
    p = (0.5 * M1 + M2) * L
    M = np.array(
        [
            [m, p * np.cos(a), M2 * C * np.cos(b)],
            [p * np.cos(a), J1 + (0.25 * M1 + M2) * L**2, M2 * L * C * np.cos(a - b)],
            [M2 * C * np.cos(b), M2 * L * C * np.cos(a - b), J + M2 * C**2],
        ]
    )
    h = np.array(
        [
            p * np.sin(a) * va**2 + M2 * C * np.sin(b) * vb**2,
            -p * G * np.sin(a) - M2 * L * C * np.sin(a - b) * vb**2,
            -M2 * C * G * np.sin(b) + M2 * L * C * np.sin(a - b) * va**2,
        ]
    )
    return M, h


def elbow(s: np.ndarray, mode: str, direction: float) -> tuple[np.ndarray, float, float]:
    """Accelerations, normal and tangential force of the elbow: z = −L cos α, x + L sin α."""
    a, va = s[1], s[4]
    M, h = arm_equations(s)
    normal, along = np.array([0.0, L * np.sin(a), 0.0]), np.array([1.0, L * np.cos(a), 0.0])
    bends = np.array([L * np.cos(a) * va**2, -L * np.sin(a) * va**2])
    if mode == "free":
        return np.linalg.solve(M, h), 0.0, 0.0
    rows = np.array([normal, along]) if mode == "stick" else normal[None]
    forces = rows.T if mode == "stick" else (normal - MU * direction * along)[:, None]
    K = np.block([[M, -forces], [rows, np.zeros((len(rows), len(rows)))]])
    x = np.linalg.solve(K, np.concatenate([h, -bends[: len(rows)]]))
    return x[:3], x[3], x[4] if mode == "stick" else -MU * direction * x[3]


@pytest.mark.parametrize("swing", [9.0, 14.0])
def test_an_arm_with_one_elbow_on_the_floor_sticks_slips_and_lifts_off(swing):
    """The forearm swings under a resting elbow: onset of slip and lift-off at the times of equations made by hand."""
    start = np.array([-L * np.sin(A), A, 0.0, 0.0, 0.0, swing])
    end, t, s, mode, direction = 0.35, 0.0, start, "stick", 1.0
    expected, path = [], []
    _, f_n, f_t = elbow(s, "stick", direction)
    assert f_n > 0.0
    assert abs(f_t) < STATIC * f_n
    while t < end and mode != "free":

        def rate(_: float, s: np.ndarray, mode: str = mode, direction: float = direction) -> np.ndarray:
            return np.concatenate([s[3:], elbow(s, mode, direction)[0]])

        def lift(_: float, s: np.ndarray, mode: str = mode, direction: float = direction) -> float:
            return elbow(s, mode, direction)[1]

        def slip(_: float, s: np.ndarray, mode: str = mode, direction: float = direction) -> float:
            if mode == "stick":
                _, f_n, f_t = elbow(s, mode, direction)
                return STATIC * f_n - abs(f_t)
            return direction * (s[3] + L * np.cos(s[1]) * s[4]) + 1e-12

        lift.terminal, lift.direction = True, -1.0  # type: ignore[attr-defined]
        slip.terminal, slip.direction = True, -1.0  # type: ignore[attr-defined]
        piece = solve_ivp(rate, (t, end), s, "DOP853", rtol=1e-13, atol=1e-15, events=(lift, slip), dense_output=True)
        path.append((t, piece.sol))
        t, s = piece.t[-1], piece["y"][:, -1]
        if piece.status == 0:
            break
        if piece.t_events[0].size:
            expected.append((t, ke.LIFT_OFF))
            mode = "free"
        elif mode == "stick":
            direction = -np.sign(elbow(s, mode, direction)[2])
            expected.append((t, ke.SLIP_START))
            mode = "slip"
        else:
            expected.append((t, ke.SLIP_STOP))
            mode = "stick"
            _, f_n, f_t = elbow(s, mode, direction)
            if abs(f_t) > STATIC * f_n:
                raise AssertionError("choose another swing: this reversal passes")
    b = arm()
    y = b.state(np.array([start[0], A, -A]), np.array([0.0, 0.0, swing]))
    run = b.simulate(y, np.linspace(0.0, end, 71), "dopri5", **TIGHT)
    found_events = [(when, kind) for when, _, kind in events(run)][: len(expected)]
    assert [kind for _, kind in found_events] == [kind for _, kind in expected]
    assert len(expected) >= 1
    np.testing.assert_allclose([w for w, _ in found_events], [w for w, _ in expected], rtol=0, atol=1e-8)
    known = run.sample_time <= t
    for sample, q in zip(run.sample_time[known], run.states("q")[known], strict=True):
        solution = [sol for begin, sol in path if begin <= sample][-1]
        np.testing.assert_allclose([q[0], q[1], q[1] + q[2]], solution(sample)[:3], rtol=0, atol=1e-8)
    assert np.abs(ledger_residual(run)).max() < 1e-9


def rod(mu: float, phi: float, contacts: int = 1, **law: float) -> CompiledSystem:
    """A thin rod of 1 kg and 1 m in the plane y = 0, leaning by φ, its lower or both ends on the floor."""
    half = 0.5
    inertia = Inertia(1.0, np.zeros(3), np.diag([half**2 / 3, half**2 / 3, 0.0]))
    links = (
        Link("cart", "x", None, "prismatic", X, Inertia(0.0)),
        Link("lift", "z", "cart", "prismatic", Z, Inertia(0.0)),
        Link("rod", "turn", "lift", "revolute", Y, inertia),
    )
    ends = [touching("rod", side * half * Z, friction=mu, **law) for side in (-1.0, 1.0)][:contacts]
    robot = Robot("rod", links, (), ("rod", -half * Z), q0=np.array([0.0, half * np.cos(phi), phi]))
    return assemble(robot, ends, real=True)


@pytest.mark.parametrize("mu", [0.1, 0.3, 0.6])
def test_a_rod_falls_flat(mu):
    """Its foot sticks, slips and may leave; its head lands; it rocks to rest, flat, and what it had is all booked."""
    b = rod(mu, 0.2, 2)
    run = b.simulate(b.state(b.robot.initial, np.zeros(3)), np.linspace(0.0, 3.0, 301), "dopri5", rtol=1e-10)
    kinds = [kind for _, k, kind in events(run) if k == 0]
    # At the start it is held if μ is above what a rod at rest needs, 0.14.
    assert (kinds[0] == ke.SLIP_START) == (mu > 0.2)
    assert any(k == 1 and kind == ke.LANDING for _, k, kind in events(run))
    touch, q = run.outputs("contact"), run.states("q")
    assert touch[:, :, OUT_GAP].min() >= -1e-9
    assert touch[:, :, OUT_FORCE].min() >= -1e-9
    np.testing.assert_allclose(touch[-1, :, OUT_FORCE].sum(), G, rtol=1e-9)
    assert (touch[-1, :, OUT_MODE] == ka.STICKING).all()
    np.testing.assert_allclose(q[-1, 1:], [0.0, 0.5 * np.pi], atol=1e-8)
    assert np.abs(run.states("v")[-1]).max() < 1e-8
    assert np.abs(ledger_residual(run)).max() < 1e-9
    spent = run.states("ledger")[-1, 5] + run.states("loss")[-1].sum()
    assert spent == pytest.approx(G * 0.5 * np.cos(0.2), rel=1e-8)


@pytest.mark.parametrize(("turn", "sense"), [(0.0, 1.0), (12.0, -1.0)])
def test_the_paradox_of_a_sliding_rod_is_named(turn, sense):
    """W_n = 1 + 3 s (s − μ c) < 0: no normal force where the free end falls onto the floor, several where it rises."""
    mu, phi, half = 2.0, 0.6, 0.5
    b = rod(mu, phi)
    s, c = np.sin(phi), np.cos(phi)
    assert 1.0 + 3.0 * s * (s - mu * c) < 0.0
    # Acceleration of the foot without a force: −g + ω² l cos φ.
    assert np.sign(-G + turn**2 * half * c) == -sense
    rise = -half * s * turn
    v = np.array([-5.0, rise, turn])
    y = b.state(b.robot.initial, v)
    b.derivative(y)
    assert abs(b.ws.contacts[0, ka.GAP_RATE]) < 1e-12
    run = b.advance(b.new_run(y, np.linspace(0.0, 0.1, 3), "dopri5"))
    assert run.count[ki.STATUS] in (ki.FORCES_REVERSED, ki.NO_CONTACT_FORCES)
    assert run.clock[ki.TIME] == 0.0


@pytest.mark.parametrize("scene", ["block on a slope", "propped arm"])
def test_nothing_creeps_for_an_hour(scene):
    """Below its cone a point that sticks stays where it is: MuJoCo 4 creeps by 50 to 900 µm/s."""
    if scene == "propped arm":
        # An arch of two rods from a hinge to a hand on the floor, which thrusts outwards by a third of its load.
        slim = Inertia(0.6, vector(0.0, 0.0, -0.15), np.diag([0.0045, 0.0045, 0.0]))
        links = (
            Link("upper", "shoulder", None, "revolute", -Y, slim, p_PJ=0.3 * (np.cos(2.2) + np.cos(0.5)) * Z),
            Link("fore", "elbow", "upper", "revolute", -Y, slim, p_PJ=-0.3 * Z),
        )
        q = np.array([2.2, 0.5 - 2.2])
        b = assemble(
            Robot("arm", links, (), ("fore", -0.3 * Z), q0=q), [touching("fore", -0.3 * Z, friction=0.5)], real=True
        )
    else:
        names = "xyz"
        links = tuple(
            Link(n, f"j{n}", names[k - 1] if k else None, "prismatic", np.eye(3)[k], Inertia(3.0 if n == "z" else 0.0))
            for k, n in enumerate(names)
        )
        q, alpha = np.zeros(3), 0.46
        normal = vector(np.sin(alpha), 0.0, np.cos(alpha))
        b = assemble(
            Robot("block", links, (), ("z", np.zeros(3))), [touching("z", np.zeros(3), normal, friction=0.5)], real=True
        )
    run = b.advance(b.new_run(b.state(q, 0.0 * q), np.linspace(0.0, 3600.0, 61), "dopri5"))
    assert run.count[ki.STATUS] == ki.FINISHED
    assert not events(run)
    touch = run.outputs("contact")
    assert (touch[:, 0, OUT_MODE] == ka.STICKING).all()
    f, force = touch[0, 0, OUT_FORCE], touch[0, 0, OUT_VECTOR : OUT_VECTOR + 3]
    # It leans on its friction.
    assert float(np.linalg.norm(force)) > 1.04 * f
    assert np.linalg.norm(run.outputs("contact")[:, 0, OUT_GAP]) <= 1e-9
    moved = run.outputs("hand") - run.outputs("hand")[0]
    # Of the gap and of both directions along the surface, each, the projection leaves what it tolerates.
    assert np.linalg.norm(moved, axis=1).max() <= np.sqrt(3.0) * GAP_TOLERANCE
