"""Forces of dependent rows with sliding contacts: the least change from those at the last change of modes."""

from __future__ import annotations

import numpy as np
import pytest
from support.random_robots import CompiledSystem, assemble

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.rows import set_modes
from dynsim.dynamics.contact.shares import even_out, keep_shares, share_slot
from dynsim.dynamics.derivative import derivative, new_workspace
from dynsim.dynamics.tables import OPEN, SLIDING, STICKING, Workspace
from dynsim.jit.kernel import integers
from dynsim.model.description import Contact, Coupling, Inertia, Link, Quadric, Robot, vector

AT_REST = np.zeros(4)


def block(masses: tuple[float, float] = (0.5, 2.0)) -> CompiledSystem:
    """A block on two slides with feet on floor and ceiling; a joint with dry friction, and one coupled to it."""
    slides = Link("slides", "along", None, "prismatic", vector(1, 0, 0), Inertia(masses[0]))
    rises = Link("rises", "up", "slides", "prismatic", vector(0, 0, 1), Inertia(masses[1]))
    leads = Link("leads", "leader", None, "prismatic", vector(0, 1, 0), Inertia(1.0), friction=2.0)
    follows = Link("follows", "follower", None, "prismatic", vector(0, 0, 1), Inertia(0.3))
    robot = Robot(
        "block",
        (slides, rises, leads, follows),
        (),
        ("rises", np.zeros(3)),
        couplings=(Coupling("follower", "leader", 0.5, 0.0),),
    )
    floor, ceiling = (Quadric(np.zeros((3, 3)), vector(0, 0, side), 0.0) for side in (1.0, -1.0))
    feet = [
        Contact("a", "rises", vector(0.1, 0, 0), floor, friction=0.2),
        Contact("b", "rises", vector(-0.1, 0, 0), floor, friction=0.5),
        Contact("c", "rises", vector(0, 0, 0), ceiling, friction=0.3),
    ]
    return assemble(robot, feet, held=AT_REST, real=True, dry=True)


def evaluated(b: CompiledSystem, ws: Workspace, v: float = 0.0) -> np.ndarray:
    """Accelerations while the block slides at v."""
    y = b.state(AT_REST, np.array([v, 0.0, 0.0, 0.0]))
    dy = np.zeros_like(y)
    derivative(b.system, 0.0, y, ws, dy)
    return ws.joints[:, ka.QDD].copy()


def begun(modes: list[int], v: float = 0.1) -> tuple[CompiledSystem, Workspace]:
    b = block()
    ws = new_workspace(b.system)
    b.system.unilateral.dry_table[:, ku.DRY_HOLDS] = 1
    evaluated(b, ws, v)
    set_modes(b.system.contacts, b.system.couplings, b.system.unilateral, ws, integers(np.array(modes)))
    b.system.unilateral.number[ku.REDUNDANT] = 1.0
    evaluated(b, ws, v)
    return b, ws


def forces(ws: Workspace) -> np.ndarray:
    return ws.rows[: ws.counts[ka.ROWS], ka.FORCE].copy()


def test_every_row_has_its_own_share() -> None:
    for modes in ([SLIDING, SLIDING, SLIDING], [STICKING, OPEN, SLIDING], [OPEN, STICKING, STICKING]):
        b, ws = begun(modes)
        unilateral = b.system.unilateral
        slots = [share_slot(unilateral, ws, r) for r in range(ws.counts[ka.ROWS])]
        assert len(set(slots)) == len(slots)
        assert min(slots) == 0
        assert max(slots) < len(unilateral.shares)


def test_forces_are_the_least_change_from_those_at_the_last_change_of_modes() -> None:
    """Those of least norm pull at the ceiling; the least change from pushing forces does not."""
    b, ws = begun([SLIDING, SLIDING, SLIDING])
    unilateral, p = b.system.unilateral, ws.counts[ka.ROWS]
    least, acceleration = forces(ws), evaluated(b, ws, 0.1)
    assert least[-1] < 0.0
    right, W = ws.rows[:p, ka.RHS].copy(), ws.small[0, :p, :p].copy()
    _, values, null = np.linalg.svd(W)
    null = null[values < 1e-9 * values[0]]
    assert len(null) == 2
    shares = least + null.T @ np.array([-3.0, 5.0])
    for r in range(p):
        unilateral.shares[share_slot(unilateral, ws, r)] = shares[r]
    unilateral.number[ku.SHARED] = 1.0
    other = evaluated(b, ws, 0.1)
    # Shares that solve the rows are the forces; their friction gives a different motion.
    np.testing.assert_allclose(forces(ws), shares, rtol=0, atol=1e-12 * np.abs(shares).max())
    np.testing.assert_array_equal(ws.rows[:p, ka.RHS], right)
    assert abs(other[0] - acceleration[0]) > 0.1
    # Other shares are changed by no more than that needs.
    off = np.arange(1.0, p + 1.0)
    for r in range(p):
        unilateral.shares[share_slot(unilateral, ws, r)] += off[r]
    evaluated(b, ws, 0.1)
    change = forces(ws) - shares - off
    np.testing.assert_allclose(W @ forces(ws), right, rtol=0, atol=1e-12 * np.abs(shares).max())
    assert np.abs(null @ change).max() < 1e-12 * np.abs(shares).max()


def test_normal_forces_are_continuous_where_a_point_begins_to_slip() -> None:
    """Two sticking feet and a sliding one, whose forces are not of least norm."""
    modes, later = (integers(np.array([first, STICKING, SLIDING])) for first in (STICKING, SLIDING))
    for shared in (1.0, 0.0):
        b, ws = begun(modes.tolist(), v=0.0)
        unilateral = b.system.unilateral
        for k, more in enumerate((1.0, 2.0, 3.0)):
            r = ws.active[k, ka.FIRST_ROW]
            unilateral.shares[share_slot(unilateral, ws, r)] = ws.rows[r, ka.FORCE] + more
        unilateral.number[ku.SHARED] = 1.0
        evaluated(b, ws)
        before = [ws.rows[ws.active[k, ka.FIRST_ROW], ka.FORCE] for k in range(3)]
        assert before[1] - before[0] == pytest.approx(1.0)
        keep_shares(unilateral, ws, later)
        set_modes(b.system.contacts, b.system.couplings, unilateral, ws, later)
        unilateral.number[ku.SHARED] = shared
        evaluated(b, ws)
        now = [ws.rows[ws.active[k, ka.FIRST_ROW], ka.FORCE] for k in range(3)]
        assert (np.abs(np.subtract(now, before)).max() < 1e-12) == (shared == 1.0)


def test_what_sticks_keeps_its_split_of_least_norm() -> None:
    b, ws = begun([STICKING, STICKING, SLIDING], v=0.0)
    unilateral, p = b.system.unilateral, ws.counts[ka.ROWS]
    shares = np.random.default_rng(5).normal(size=p)
    for r in range(p):
        unilateral.shares[share_slot(unilateral, ws, r)] = shares[r]
    W = ws.small[0, :p, :p].copy()
    even_out(unilateral, ws)
    evened = np.array([unilateral.shares[share_slot(unilateral, ws, r)] for r in range(p)])
    np.testing.assert_allclose(W @ evened, W @ shares, rtol=0, atol=1e-12)
    assert evened[-1] == shares[-1]
    # Both feet have half of their common load.
    a, c = ws.active[0, ka.FIRST_ROW], ws.active[1, ka.FIRST_ROW]
    np.testing.assert_allclose(evened[a : a + 3], evened[c : c + 3], rtol=0, atol=1e-12)


@pytest.mark.parametrize("modes", [[SLIDING, SLIDING, OPEN], [STICKING, STICKING, OPEN]])
def test_shares_are_kept_only_where_something_slides(modes: list[int]) -> None:
    b, ws = begun(modes)
    keep_shares(b.system.unilateral, ws, integers(np.array(modes)))
    assert b.system.unilateral.number[ku.SHARED] == (1.0 if SLIDING in modes else 0.0)
