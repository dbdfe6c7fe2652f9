"""Existence of forces by Coulomb's law at one state: exact, by branching over modes and slip directions.

With a mode for each contact and resting joint the law is linear, except for the disc of a sticking contact and the
direction in which a contact at rest begins to slip. The disc is cut by tangents where a solution leaves it. Directions
are branched into sectors, in each of which the law is relaxed to the hull of its arc. If a relaxed branch has no
solution, the branch has none either; a sector as narrow as rounding has a solution if its hull has one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

Array = NDArray[np.float64]

# Relative violation that counts as zero: the tolerance of the linear programs.
SOLVED = 1e-7
# Narrower sectors count as a direction: the hull deviates from its arc by their square [rad].
NARROW = 1e-4
# Maximum number of cuts of one disc by tangents: each leaves a fraction of the violation.
CUTS = 40
OPEN, PRESSED, STICKS = "open", "pressed", "sticks"


@dataclass(frozen=True)
class Point:
    """A closed contact, with three rows from ``row`` on, normal first; without friction, and for a joint stop, one row.

    ``friction`` is its coefficient, static at rest; ``direction`` is the direction of its slip, (2,), None at rest.
    """

    row: int
    friction: float
    direction: Array | None = None


@dataclass(frozen=True)
class Rest:
    """A joint at rest, with its row and the bound of its dry friction."""

    row: int
    bound: float


def _rows(m: Point | Rest) -> list[int]:
    return list(range(m.row, m.row + 3)) if isinstance(m, Point) and m.friction > 0.0 else [m.row]


@dataclass
class _Program:
    """Constraints G x ≤ g, E x = e on x, with f = F x."""

    F: Array
    upper: list[tuple[Array, float]] = field(default_factory=list)
    equal: list[tuple[Array, float]] = field(default_factory=list)


def forces_exist(W: Array, b: Array, points: Sequence[Point], rests: Sequence[Rest]) -> bool:
    """Whether there is an f with accelerations a = W f + b by Coulomb's law; ``W`` : (p, p), ``b`` : (p,).

    Parts that do not affect each other are decided separately.
    """
    members: list[Point | Rest] = [*points, *rests]
    blocks = [_rows(m) for m in members]
    return all(_part_has_forces(W, b, [members[k] for k in part]) for part in parts(W, blocks))


def parts(W: Array, blocks: Sequence[Sequence[int]]) -> list[list[int]]:
    """Return sets of blocks of rows such that no force along one set moves another."""
    sizes = np.sqrt(np.abs(np.diag(W)))
    result, left = [], set(range(len(blocks)))
    while left:
        part: list[int] = []
        ahead = [left.pop()]
        while ahead:
            part.append(k := ahead.pop())
            for m in sorted(left):
                both = np.ix_(blocks[k], blocks[m])
                if (np.abs(W[both]) > 1e-12 * np.outer(sizes[blocks[k]], sizes[blocks[m]])).any():
                    left.remove(m)
                    ahead.append(m)
        result.append(sorted(part))
    return result


def _part_has_forces(W: Array, b: Array, members: Sequence[Point | Rest]) -> bool:
    rows = [r for m in members for r in _rows(m)]
    index = {r: i for i, r in enumerate(rows)}
    # Rows and forces are scaled to a diagonal and a right-hand side of one.
    units = np.ones(len(rows))
    for m in members:
        own = [index[r] for r in _rows(m)]
        units[own] = 1.0 / np.sqrt(max(float(np.mean(np.diag(W)[[rows[i] for i in own]])), 1e-300))
    scaled = units[:, None] * W[np.ix_(rows, rows)] * units
    right = units * b[rows]
    size = float(np.abs(right).max(initial=0.0))
    if size == 0.0:
        return True
    right = right / size
    own_members: list[Point | Rest] = [
        Point(index[m.row], m.friction, m.direction)
        if isinstance(m, Point)
        else Rest(index[m.row], m.bound / (units[index[m.row]] * size))
        for m in members
    ]
    # Modes chosen for the first members; the others may have any mode.
    stack: list[tuple[object, ...]] = [()]
    while stack:
        chosen = stack.pop()
        wide = [i for i, mode in enumerate(chosen) if isinstance(mode, tuple) and mode[1] - mode[0] > NARROW]
        if not _feasible(scaled, right, own_members, chosen):
            continue
        if len(chosen) < len(own_members):
            stack += [(*chosen, mode) for mode in _modes(own_members[len(chosen)])]
        elif wide:
            i = max(wide, key=lambda i: chosen[i][1] - chosen[i][0])  # type: ignore[index]
            sector = np.array(chosen[i])
            halves = np.linspace(sector[0], sector[1], 3).tolist()
            stack += [(*chosen[:i], half, *chosen[i + 1 :]) for half in (tuple(halves[:2]), tuple(halves[1:]))]
        else:
            return True
    return False


def _modes(member: Point | Rest) -> list[object]:
    """Return the modes of one contact or joint, the likeliest last."""
    if isinstance(member, Rest):
        return [-1.0, 1.0, 0.0]
    if member.direction is not None or member.friction == 0.0:
        return [OPEN, PRESSED]
    quarters = np.linspace(0.0, 2.0 * np.pi, 5)
    return [OPEN, *zip(quarters[:-1].tolist(), quarters[1:].tolist(), strict=True), STICKS]


def _feasible(W: Array, b: Array, members: Sequence[Point | Rest], chosen: Sequence[object]) -> bool:
    """Whether the relaxed law has forces with the chosen modes of the first members and any modes of the others."""
    parts, count = [], 0
    for i, m in enumerate(members):
        mode = chosen[i] if i < len(chosen) else None
        directions = _directions(m, mode)
        parts.append((m, mode, directions, slice(count, count + directions.shape[1])))
        count += directions.shape[1]
    F = np.zeros((len(b), count))
    for m, _, directions, own in parts:
        F[m.row : m.row + len(directions), own] = directions
    program, identity = _Program(F), np.eye(count)
    lower = np.zeros(count)
    A = W @ F
    discs = []
    for m, mode, _, own in parts:
        if isinstance(m, Rest):
            lower[own] = -np.inf
            force, a = F[m.row], A[m.row]
            program.upper += [(force, m.bound), (-force, m.bound)]
            if mode == 0.0:
                program.equal.append((a, -b[m.row]))
            elif mode is not None:
                program.equal.append((force, mode * m.bound))  # type: ignore[operator]
                program.upper.append((mode * a, -mode * b[m.row]))  # type: ignore[operator]
            continue
        n, t = m.row, (m.row + 1, m.row + 2)
        if mode is None or mode == OPEN:
            program.upper.append((-A[n], b[n]))
        else:
            program.equal.append((A[n], -b[n]))
        if mode == STICKS:
            program.equal += [(A[r], -b[r]) for r in t]
        elif isinstance(mode, tuple):
            # The acceleration is in the cone of the sector: left of its first side, right of its last.
            for sign, angle in zip((1.0, -1.0), mode, strict=True):
                side = sign * np.array([-np.sin(angle), np.cos(angle)])
                program.upper.append((-(side @ A[list(t)]), float(side @ b[list(t)])))
        if mode == STICKS or (mode is None and m.direction is None and m.friction > 0.0):
            lower[own] = [0.0, -np.inf, -np.inf]
            discs.append((m, own))
            for angle in np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False):
                program.upper.append((_tangent(identity, m, own, angle), 0.0))
    for _ in range(CUTS):
        x = _solve(program, lower)
        if x is None:
            return False
        outside = [(m, own) for m, own in discs if np.hypot(*x[own][1:]) > m.friction * x[own][0] + SOLVED]
        if not outside:
            return True
        program.upper += [(_tangent(identity, m, own, np.arctan2(x[own][2], x[own][1])), 0.0) for m, own in outside]
    return True


def _directions(m: Point | Rest, mode: object) -> Array:
    """Return the directions whose non-negative combinations form a member's force, except for discs and joints."""
    if isinstance(m, Rest):
        return np.ones((1, 1))
    if mode == OPEN:
        return np.zeros((len(_rows(m)), 0))
    if m.friction == 0.0:
        return np.ones((1, 1))
    if m.direction is not None:
        return np.concatenate([[1.0], -m.friction * m.direction])[:, None]
    if not isinstance(mode, tuple):
        return np.eye(3)
    low, high = mode
    half = 0.5 * (high - low)
    angles, sizes = np.array([low, low + half, high]), np.array([1.0, 1.0 / np.cos(half), 1.0])
    return np.stack([np.ones(3), -m.friction * sizes * np.cos(angles), -m.friction * sizes * np.sin(angles)])


def _tangent(identity: Array, m: Point, own: slice, angle: float) -> Array:
    """Return the coefficients of f_t·e − μ f_n ≤ 0."""
    return np.cos(angle) * identity[own][1] + np.sin(angle) * identity[own][2] - m.friction * identity[own][0]


def _solve(program: _Program, lower: Array) -> Array | None:
    if not len(lower):
        held = all(abs(e) <= SOLVED for _, e in program.equal) and all(g >= -SOLVED for _, g in program.upper)
        return np.zeros(0) if held else None
    G, g = [np.array([entry[i] for entry in program.upper]) for i in (0, 1)]
    E, e = [np.array([entry[i] for entry in program.equal]) for i in (0, 1)]
    solution = linprog(
        np.zeros(len(lower)),
        A_ub=G if len(G) else None, b_ub=g if len(G) else None,
        A_eq=E if len(E) else None, b_eq=e if len(E) else None,
        bounds=[(low, None) for low in lower],
        method="highs",
    )  # fmt: skip
    return np.asarray(solution.x) if solution.status == 0 else None
