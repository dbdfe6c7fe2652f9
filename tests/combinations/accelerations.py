"""The problem of accelerations and contact forces at one state, computed from the bodies only.

Only points and joints at rest have open modes. Mass matrix and Jacobians are computed without the kernels; drift
accelerations of points are differences of their velocities.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from combinations.bodies import position_rates, times
from combinations.coulomb import Point, Rest, forces_exist, parts
from combinations.observed import Observed
from dynsim.model.drives import Motor

Array = NDArray[np.float64]

# Largest gap of a closed contact [m]; largest rate at rest [m/s, rad/s].
CLOSED, RESTS = 1e-5, 1e-5
# Largest gap and normal rate of contacts that stay closed: tolerances of projection [m, m/s].
MET, STAYS = 1e-9, 3e-8
# Determinants and diagonals below this fraction of the frictionless ones count as zero: a step ends just before.
CRITICAL = 0.02
# Largest number of joints and contacts whose combinations are examined individually.
FEW = 8
# Steps of the differences for the drift of a point [s].
DRIFT_STEP = 1e-4
# Sweeps and damping of the projected iteration, and the relative violation that counts as zero.
SWEEPS, DAMPING, SOLVED = 20000, 0.7, 1e-7
# Larger relative changes mean that the iteration diverges, which shows nothing about forces.
DIVERGED = 1e12


@dataclass(frozen=True)
class State:
    """The bodies at one instant.

    Attributes
    ----------
    q, v, current : ndarray
        Positions, rates and currents.
    mass : (n, n) ndarray
        M + J_m.
    names, rows, slip : list
        Closed contacts; normal and two tangents of each, (3, n); slip along the tangents, (2,) [m/s].
    gaps, friction, smoothing : list
        Gap [m] and coefficient of each; speed below which the friction of a glued contact fades [m/s].
    resting : list
        Joints at rest with dry friction, and their bounds.
    stops : list
        Joints at rest on a stop, with the sign of the rate at which each leaves.
    """

    q: Array
    v: Array
    current: Array
    mass: Array
    names: list[str]
    rows: list[Array]
    gaps: list[float]
    slip: list[Array]
    friction: list[float]
    smoothing: list[float]
    static: list[float]
    resting: list[int]
    bounds: list[float]
    rubbing: Array
    stops: list[tuple[int, float]]


def state_of(seen: Observed, values: Mapping[str, Sequence[float]], currents: Array | None = None) -> State:
    """Return the state of a stop, or of the last sample; ``currents`` : currents of all drives, if known."""
    q = np.array(values["q"]) if "q" in values else seen.q[-1]
    v = np.array(values["v"]) if "v" in values else seen.v[-1]
    motion = seen.bodies.motion(q[None], v[None], np.zeros((1, len(v))))
    names, rows, gaps, slip, friction, smoothing, static = [], [], [], [], [], [], []
    for contact in seen.described_contacts:
        body, centre, far, normal = seen.nearest_point(contact, motion)
        if seen.real and far[0] - contact.radius > CLOSED:
            continue
        n = np.asarray(normal[0], dtype=np.float64)
        along = np.cross(n, np.eye(3)[np.abs(n).argmin()])
        along /= np.linalg.norm(along)
        frame = np.stack([n, along, np.cross(n, along)])
        J = frame @ seen.bodies.jacobian(motion, body, centre - contact.radius * normal)[0]
        names.append(contact.name)
        rows.append(J)
        gaps.append(float(far[0] - contact.radius))
        slip.append((J @ v)[1:])
        speed = float(np.linalg.norm(slip[-1]))
        mu = contact.friction + contact.viscous_friction * speed
        if contact.stribeck > 0.0:
            mu += (contact.friction_at_rest - contact.friction) * float(np.exp(-((speed / contact.stribeck) ** 2)))
        friction.append(mu)
        smoothing.append(contact.slip_smoothing)
        static.append(contact.friction_at_rest)
    gears = {motor.joint: getattr(motor, "dry_friction", 0.0) for motor in seen.robot.motors}
    bound = np.array([link.friction + gears.get(link.joint, 0.0) for link in seen.robot.links]) * seen.real
    resting = [int(j) for j in np.flatnonzero((bound > 0.0) & (np.abs(v) < RESTS))]
    rubbing = np.where((bound > 0.0) & (np.abs(v) >= RESTS), -bound * np.sign(v), 0.0)
    recorded = seen.record["current"]
    # Without a sample the run has not begun, and currents are zero.
    current = currents if currents is not None else recorded[-1].copy() if len(seen) else np.zeros(recorded.shape[1])
    circuits = [a for a, motor in enumerate(seen.robot.motors) if isinstance(motor, Motor)]
    if circuits and currents is None and len(values.get("current", ())) == len(circuits):
        # Currents of circuits belong to the state, other currents to the last sample.
        current[circuits] = values["current"]
    mass = seen.bodies.mass_matrix(q)
    bounds = [float(bound[j]) for j in resting]
    stops = []
    for j, link in enumerate(seen.robot.links if seen.real else ()):
        position = q[seen.bodies.places[j]]
        for gap, side in ((position - link.lower, 1.0), (link.upper - position, -1.0)):
            if gap < MET and abs(v[j]) < STAYS:
                stops.append((j, side))
    return State(
        q, v, current, mass, names, rows, gaps, slip, friction, smoothing, static, resting, bounds, rubbing, stops
    )


def critical(seen: Observed, values: Mapping[str, Sequence[float]]) -> bool:
    """Whether some combination of modes has a paradox: contacts slide, and others stick, joints rest or are released.

    A sliding contact has the direction of its slip or, at rest, any direction.
    """
    whole, basis = state_of(seen, values), seen.bodies.free_directions()
    identity, count = np.eye(len(whole.v)), len(whole.names)
    rows = np.vstack([np.zeros((0, len(whole.v))), *whole.rows, *(identity[j][None] for j in whole.resting)])
    inverse = _mobility(whole, basis)
    W = rows @ inverse @ rows.T
    blocks = [[3 * k, 3 * k + 1, 3 * k + 2] for k in range(count)]
    blocks += [[3 * count + m] for m in range(len(whole.resting))]
    # A part in which all contacts slide has no other modes, whatever the other parts do.
    for part in parts(W, blocks):
        slides = max(part) < count and all(float(np.linalg.norm(whole.slip[k])) > RESTS for k in part)
        if slides and _paradox(whole, part, inverse, (1.0,) if seen.real else (1.0, -1.0)):
            return True
    return _some_modes_critical(whole, basis, real=seen.real)


def _mobility(state: State, basis: Array) -> Array:
    """Return the accelerations of unit forces in the free directions of a basis, (n, n)."""
    return np.asarray(basis @ np.linalg.solve(basis.T @ state.mass @ basis, basis.T))


def _some_modes_critical(state: State, basis: Array, *, real: bool) -> bool:
    for held_joints in _subsets(state.resting):
        for mode in _modes(len(state.names)):
            sliding = [k for k, m in enumerate(mode) if m == 1]
            if not sliding:
                continue
            fixed = [np.eye(len(state.v))[j][None] for j in held_joints]
            fixed += [state.rows[k] for k, m in enumerate(mode) if m == 2]
            free = _null_space(np.vstack(fixed) @ basis, basis) if fixed else basis
            if free.shape[1] == 0:
                continue
            if _paradox(state, sliding, _mobility(state, free), (1.0,) if real else (1.0, -1.0)):
                return True
    return False


def _paradox(state: State, sliding: Sequence[int], inverse: Array, signs: Sequence[float]) -> bool:
    """Whether det or a diagonal entry of N W (N − μ T)ᵀ falls to zero.

    Considers all possible directions of slip, and all combinations of ``signs`` of normal forces.
    """
    choices = []
    for k in sliding:
        speed = float(np.linalg.norm(state.slip[k]))
        if speed > RESTS:
            choices.append([state.slip[k] / speed])
        else:
            # The direction with the largest coupling is the worst, for either sign.
            normal, tangents = state.rows[k][0], state.rows[k][1:]
            coupling = tangents @ inverse @ normal
            size = float(np.linalg.norm(coupling))
            worst = coupling / size if size > 0.0 else np.array([1.0, 0.0])
            choices.append([worst, -worst])
    N = np.stack([state.rows[k][0] for k in sliding])
    bare = N @ inverse @ N.T
    values = np.linalg.eigvalsh(bare)
    if values[0] <= 1e-11 * values[-1]:
        return False
    for directions in itertools.islice(itertools.product(*choices), 64):
        # At rest the static coefficient may apply.
        mu = [max(state.friction[k], state.static[k]) for k in sliding]
        T = np.stack([direction @ state.rows[k][1:] for k, direction in zip(sliding, directions, strict=True)])
        # Each glued contact may pull, which reverses its own friction.
        for turned in itertools.islice(itertools.product(signs, repeat=len(sliding)), 64):
            A = bare - N @ inverse @ ((np.array(turned) * mu)[:, None] * T).T
            if np.linalg.det(A) < CRITICAL * np.linalg.det(bare) or (np.diag(A) < CRITICAL * np.diag(bare)).any():
                return True
    return False


def exists(seen: Observed, values: Mapping[str, Sequence[float]], time: float) -> bool:
    """Whether contact forces that agree with Coulomb's law exist at a state, by an exact decision.

    Forces act only if a gap stays closed, not if a contact is still approaching the surface or leaves it.
    """
    state = state_of(seen, values)
    speeds = [abs(float(rows[0] @ state.v)) / (1.0 + float(np.linalg.norm(slip)))
              for rows, slip in zip(state.rows, state.slip, strict=True)]  # fmt: skip
    state = _only(state, [k for k, speed in enumerate(speeds) if state.gaps[k] < MET and speed < STAYS])
    W, free = _problem(seen, state, time)[:2]
    points = []
    for k, slip in enumerate(state.slip):
        speed = float(np.linalg.norm(slip))
        points.append(Point(3 * k, state.friction[k], slip / speed) if speed > RESTS else Point(3 * k, state.static[k]))
    c = 3 * len(state.names)
    rests = [Rest(c + m, bound) for m, bound in enumerate(state.bounds)]
    stops = [Point(c + len(rests) + m, 0.0) for m in range(len(state.stops))]
    return forces_exist(W, free, [*points, *stops], rests)


def _only(state: State, kept: Sequence[int]) -> State:
    """Return a state with only these contacts."""
    lists = ("names", "rows", "gaps", "slip", "friction", "smoothing", "static")
    kept_lists: dict[str, Any] = {key: [getattr(state, key)[k] for k in kept] for key in lists}
    return replace(state, **kept_lists)


def leaves(seen: Observed, name: str, i: int) -> bool:
    """Whether a contact would leave its surface at a sample without its force, with all other forces."""
    state = state_of(seen, {"q": seen.q[i].tolist(), "v": seen.v[i].tolist()}, seen.record["current"][i])
    if name not in state.names:
        return True
    k = state.names.index(name)
    others = [m for m in range(len(state.names)) if m != k]
    solved, acceleration = _solved(seen, _only(replace(state, stops=[]), others), float(seen.time[i]))
    drift = _drifts(seen, state)[k][0]
    gain = float(state.rows[k][0] @ acceleration + drift)
    return solved and gain > -1e-6 * (np.abs(acceleration).max(initial=0.0) + 1.0)


def _solved(seen: Observed, state: State, time: float) -> tuple[bool, Array]:
    """Return whether a damped projected iteration finds Coulomb forces, and the accelerations with them, (n,)."""
    W, free, rows, inverse, push = _problem(seen, state, time)
    if not len(rows):
        return True, inverse @ push
    c = len(state.names)
    f = np.zeros(len(rows))
    scale = np.abs(free).max(initial=0.0) + 1e-9
    for _ in range(SWEEPS):
        before = f.copy()
        for k in range(c):
            _contact(state, k, W, free, f)
        for m, bound in enumerate(state.bounds):
            r = 3 * c + m
            wanted = f[r] - (W[r] @ f + free[r]) / W[r, r]
            f[r] += DAMPING * (np.clip(wanted, -bound, bound) - f[r])
        change = float(np.abs(W @ (f - before)).max())
        if change < 1e-13 * scale or not change < DIVERGED * scale:
            break
    return _violation(state, W, free, f) < SOLVED * scale, inverse @ (push + rows.T @ f)


def _problem(seen: Observed, state: State, time: float) -> tuple[Array, Array, Array, Array, Array]:
    """Return W and b of the accelerations W f + b along contacts, resting joints and stops; rows, M⁻¹, push."""
    push, n = _applied(seen, state, time), len(state.v)
    inverse = _mobility(state, seen.bodies.free_directions())
    joints = [np.eye(n)[j][None] for j in state.resting] + [side * np.eye(n)[j][None] for j, side in state.stops]
    rows = np.vstack([np.zeros((0, n)), *state.rows, *joints])
    free = rows @ inverse @ push + np.concatenate([_drifts(seen, state).ravel(), np.zeros(len(joints))])
    return rows @ inverse @ rows.T, free, rows, inverse, push


def glued_forces(seen: Observed, values: Mapping[str, Sequence[float]], time: float) -> tuple[State, Array]:
    """Return the state of a stop and the normal forces of its glued contacts with smoothed friction, (c,) [N]."""
    state = replace(state_of(seen, values), resting=[], stops=[])
    W, free = _problem(seen, state, time)[:2]
    by_name = {contact.name: contact for contact in seen.described_contacts}
    signed = np.array([by_name[name].pulling_friction == "signed" for name in state.names])
    f: Array = np.ones(len(state.names))
    # Dissipative friction has the sign of its force, known from the preceding forces.
    for _ in range(1 if signed.all() else FEW):
        F = np.zeros((len(W), len(f)))
        for k, slip in enumerate(state.slip):
            smooth = float(np.hypot(np.linalg.norm(slip), state.smoothing[k]))
            F[3 * k, k] = 1.0
            F[3 * k + 1 : 3 * k + 3, k] = -state.friction[k] * (1.0 if signed[k] else np.sign(f[k])) * slip / smooth
        f = np.asarray(np.linalg.lstsq((W @ F)[::3], -free[::3], rcond=1e-12)[0], dtype=np.float64)
    return state, f


def _contact(state: State, k: int, W: Array, free: Array, f: Array) -> None:
    """Update the force of one contact with the other forces fixed."""
    r = slice(3 * k, 3 * k + 3)
    a = W[3 * k : 3 * k + 3] @ f + free[r]
    block = W[r, r]
    speed = float(np.linalg.norm(state.slip[k]))
    if speed > RESTS:
        direction = np.concatenate([[1.0], -state.friction[k] * state.slip[k] / speed])
        own = float(block[0] @ direction)
        if own <= 0.0:
            return
        f_n = max(0.0, float(f[3 * k] - a[0] / own))
        f[r] += DAMPING * (f_n * direction - f[r])
        return
    size = float(np.trace(block)) or 1.0
    wanted = f[r] - a / size
    wanted[0] = max(wanted[0], 0.0)
    tangential, most = float(np.linalg.norm(wanted[1:])), state.static[k] * wanted[0]
    if tangential > most:
        wanted[1:] *= most / max(tangential, 1e-300)
    f[r] += DAMPING * (wanted - f[r])


def _violation(state: State, W: Array, free: Array, f: Array) -> float:
    """Return the largest violation of the law by a contact or resting joint; infinite if f is not finite."""
    if not np.isfinite(f).all():
        return np.inf
    a, worst = W @ f + free, 0.0
    for k in range(len(state.names)):
        own, force = a[3 * k : 3 * k + 3], f[3 * k : 3 * k + 3]
        size = float(np.trace(W[3 * k : 3 * k + 3, 3 * k : 3 * k + 3])) or 1.0
        worst = max(worst, -own[0], min(own[0], size * force[0]))
        if float(np.linalg.norm(state.slip[k])) <= RESTS:
            moved = force - own / size
            most = state.static[k] * max(moved[0], 0.0)
            tangential = float(np.linalg.norm(moved[1:]))
            kept = moved[1:] * min(1.0, most / max(tangential, 1e-300))
            worst = max(worst, size * float(np.linalg.norm(kept - force[1:])))
    c = 3 * len(state.names)
    for m, bound in enumerate(state.bounds):
        r = c + m
        kept = np.clip(f[r] - a[r] / W[r, r], -bound, bound)
        worst = max(worst, float(W[r, r] * abs(kept - f[r])))
    return worst


def _applied(seen: Observed, state: State, time: float) -> Array:
    """Return generalised forces without contacts and resting joints, with weight and velocity products, (n,)."""
    motion = seen.bodies.motion(state.q[None], state.v[None], np.zeros((1, len(state.v))))
    push = -seen.bodies.along_rows(motion, seen.bodies.wrenches(motion))[0] - seen.bodies.damping * state.v
    push = push + seen.driven_torques(state.current[None], state.v[None])[0] + state.rubbing
    for load in seen.loads:
        body, point = seen.robot.attach(load.body, load.point)
        wrench = load.components(np.array([time]))
        parts = [wrench[:, :3], wrench[:, 3:]]
        if load.in_body:
            parts = [times(motion.rotation[body], part) for part in parts]
        push = push + seen.bodies.force_along_rows(motion, body, motion.point(body, point), *parts)[0]
    return np.asarray(push)


def _drifts(seen: Observed, state: State) -> Array:
    """Return accelerations of contacts along normal and tangents at zero joint accelerations, (c, 3) [m/s²].

    Computed from gaps and velocities of touching points, before and after at constant rates.
    """
    step = DRIFT_STEP / max(1.0, float(np.abs(state.v).max(initial=0.0)))
    steps = np.array([-step, 0.0, step])
    q = np.stack([state.q + h * position_rates(seen.bodies, state.q[None], state.v[None])[0] for h in steps])
    motion = seen.bodies.motion(q, np.repeat(state.v[None], 3, axis=0), np.zeros((3, len(state.v))))
    drifts = []
    by_name = {contact.name: contact for contact in seen.described_contacts}
    for name in state.names:
        contact = by_name[name]
        body, centre, far, normal = seen.nearest_point(contact, motion)
        velocity = motion.velocity(body, centre - contact.radius * normal)
        rate = (velocity[2] - velocity[0]) / (2.0 * step)
        n = np.asarray(normal[1])
        along = np.cross(n, np.eye(3)[np.abs(n).argmin()])
        along /= np.linalg.norm(along)
        bend = (far[2] - 2.0 * far[1] + far[0]) / step**2
        drifts.append([bend, along @ rate, np.cross(n, along) @ rate])
    return np.array(drifts).reshape(-1, 3)


def _subsets(items: Sequence[int]) -> list[tuple[int, ...]]:
    """Return all subsets of a few items; for many items all, none, and all but one."""
    if len(items) <= FEW:
        return [subset for size in range(len(items) + 1) for subset in itertools.combinations(items, size)]
    return [tuple(items), (), *(tuple(item for item in items if item != left) for left in items)]


def _modes(count: int) -> list[tuple[int, ...]]:
    """Return open, sliding, sticking for each contact; for many contacts equal modes, or one different."""
    if count <= 4:
        return list(itertools.product((0, 1, 2), repeat=count))
    alone = [tuple(1 if k == m else other for k in range(count)) for m in range(count) for other in (0, 2)]
    return [(1,) * count, *alone]


def _null_space(rows: Array, basis: Array) -> Array:
    _, sizes, vectors = np.linalg.svd(rows)
    rank = int((sizes > 1e-9 * max(sizes.max(initial=0.0), 1e-300)).sum())
    return np.asarray(basis @ vectors[rank:].T)
