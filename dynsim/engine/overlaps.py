"""Warnings of bodies that overlap too deeply: edges compressed beyond their rounding, passages through each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise, product

import numpy as np

from dynsim.compile.clearance import poses
from dynsim.compile.shapes import core_pose, overlaps, solid_row
from dynsim.compile.solids import Solid, solids_of
from dynsim.dynamics.contact import solids as ks
from dynsim.dynamics.contact import unilateral as ku
from dynsim.engine.prepare import Prepared
from dynsim.integrators import run as ki
from dynsim.model.description import Array
from dynsim.model.surfaces import Box, Capsule
from dynsim.record import Record

# Number of samples whose poses are in memory at a time.
SAMPLES = 10_000
# Motion from sample to sample, or per step, as a fraction of the smaller half thickness: below SLOW, contacts find each
# other; advised steps move SAFE.
SLOW, SAFE = 0.5, 0.1
# Factor by which the advised stiffness exceeds the estimate.
MARGIN = 2.0


def squeezed(record: Record, prepared: Prepared) -> list[str]:
    """Warn of edges and corners compressed by more than their rounding, where their normal is wrong.

    The depth of a face is the overlap along its normal. Edges or corners touch if no such overlap is as small as the
    depth, or several of one solid are.
    """
    model, unilateral, worst = prepared.model, prepared.system.unilateral, dict[str, tuple[float, str]]()
    if unilateral is None or not len(record):
        return []
    for contact, tally in zip(prepared.contacts, unilateral.tally, strict=True):
        if not contact.stiffness or not isinstance(contact.surface, Solid):
            continue
        link, start = model.robot.attach(contact.body, contact.point)
        end = start if contact.tip is None else model.robot.attach(contact.body, contact.tip)[1]
        solids = contact.solid or Capsule(start, end - start, contact.radius), contact.surface
        if not any(isinstance(solid, Box) for solid in solids):
            continue
        rows, depth = [solid_row(solid) for solid in solids], float(tally[ku.DEEPEST])
        rounding = float(rows[0][ks.CORE + 3] + rows[1][ks.CORE + 3])
        name = f"{contact.body}-{contact.surface_name}" if contact.is_between_bodies else contact.name
        excess = depth / rounding
        if not excess > max(1.0, worst.get(name, (0.0,))[0]):
            continue
        gap = record["contact_gap"][:, record.labels["contact_gap"].index(contact.name)]
        deepest = int(gap.argmin())
        cores = []
        for row, body in zip(rows, (link, contact.surface.carrier), strict=True):
            pose = (np.eye(3), np.zeros(3)) if body is None else model.body_pose(body, record["q"][deepest])
            cores.append(core_pose(row, *(part[..., None] for part in pose)))
        along = overlaps(rows, cores)[1][0, :6].reshape(2, 3)
        faces = [_has_face(row[ks.CORE : ks.CORE + 3]) for row in rows]
        if np.sum(faces & (along < rounding - gap[deepest]), axis=1).max() != 1:
            # A landing compresses springs by a depth that is proportional to 1/√k, a constant force by 1/k.
            stiffness = one_digit(MARGIN * contact.stiffness * excess**2, up=True)
            worst[name] = (
                excess,
                (
                    f"{name}: compressed by up to {1e3 * depth:.3g} mm, more than the rounding of the edges "
                    f"({1e3 * rounding:.3g} mm); direction and energy of this contact are wrong from there on; use "
                    f"stiffness_N_per_m of at least {stiffness:g}"
                ),
            )
    return [text for _, text in worst.values()]


def passed_through(record: Record, prepared: Prepared) -> list[str]:
    """Warn once for each pair of bodies that pass through each other between two samples.

    From sample to sample, the bodies count as moving straight. They pass through each other if they overlap by more
    than half the thickness of the thinner solid when their centres change sides along the axis that separated them
    before.
    """
    robot, run = prepared.model.robot, prepared.run
    pairs = dict.fromkeys((c.body, str(c.surface_name)) for c in prepared.contacts if c.is_between_bodies)
    if not pairs or len(record) < 2:
        return []
    solids = {body: [solid_row(solid) for solid in own] for body, own in solids_of(robot).items()}
    stepped = run.method == ki.TIME_STEPPING
    step, warnings = float(run.clock[ki.STEP]) if stepped else 0.0, dict[frozenset[str], str]()
    for first, last in pairwise([*range(0, len(record) - 1, SAMPLES), len(record) - 1]):
        times = record.time[first : last + 1]
        at_rest = np.repeat(np.eye(3)[..., None], len(times), axis=-1), np.zeros((3, len(times)))
        placed = {link.name: (R, p) for link, R, p in poses(robot, record["q"][first : last + 1])}
        # The solids of the root link are fixed to the world.
        moving = {
            body: [(row, core_pose(row, *placed.get(body, at_rest))) for row in rows] for body, rows in solids.items()
        }
        for pair in pairs:
            for both in product(*(moving[body] for body in pair)):
                if frozenset(pair) in warnings:
                    continue
                rows, cores = zip(*both, strict=True)
                for k, speed, thin in _passages(rows, cores, times, step):
                    longest = one_digit(SAFE * thin / speed)
                    moves = f"{1e3 * speed * step:.3g} mm per step" if stepped else f"{speed:.3g} m/s"
                    warnings[frozenset(pair)] = (
                        f"{'-'.join(pair)}: pass through each other at t = {times[k]:.4g} s, because they move too "
                        f"fast ({moves}; smaller half thickness {1e3 * thin:.3g} mm); use "
                        f"integrator.{'step_s' if stepped else 'step_max_s'}: {longest:g}"
                    )
                    break
    return list(warnings.values())


def one_digit(value: float, up: bool = False) -> float:
    """Return a positive number rounded down, or up, to one digit."""
    power = 10.0 ** np.floor(np.log10(value))
    # Just below a power of ten, the logarithm rounds up to an integer.
    return float((np.ceil if up else np.floor)(max(value / power, 1.0)) * power)


def _has_face(half: Array) -> Array:
    """Return for each axis of a core whether it is the normal of a face, whose two sides are longer than zero, (3,)."""
    return np.array([np.delete(half, k).min() > 0.0 for k in range(3)])


def _passages(
    rows: Sequence[Array], cores: Sequence[tuple[Array, Array]], times: Array, step: float
) -> Iterator[tuple[int, float, float]]:
    """Yield sample, relative speed [m/s] and smaller half thickness [m] wherever two solids pass through each other."""
    thin = min(float(row[ks.CORE : ks.CORE + 3].min() + row[ks.CORE + 3]) for row in rows)
    offset = cores[0][1] - cores[1][1]
    change, interval = np.diff(offset, axis=0), np.diff(times)
    moved = np.linalg.norm(change, axis=1)
    for row, (axes, _) in zip(rows, cores, strict=True):  # the angle of a small turn is its Frobenius norm over √2
        moved += row[ks.BOUND] * np.linalg.norm(np.diff(axes, axis=0), axis=(1, 2)) / math.sqrt(2.0)
    speed = moved / np.maximum(interval, 1e-300)
    nearest = -np.einsum("ti,ti->t", offset[:-1], change) / np.maximum(np.einsum("ti,ti->t", change, change), 1e-300)
    apart = np.linalg.norm(offset[:-1] + np.clip(nearest, 0.0, 1.0)[:, None] * change, axis=1)
    near = apart < rows[0][ks.BOUND] + rows[1][ks.BOUND]
    fast = np.flatnonzero(near & (speed * np.maximum(interval, step) > SLOW * thin))
    if not fast.size:
        return
    start = overlaps(rows, [(axes[fast], p[fast]) for axes, p in cores])[1].min(axis=1, initial=np.inf)
    last, axis, side = -1, 0, 0.0
    for k in fast[start > -moved[fast]]:
        shares = np.linspace(0.0, 1.0, int(min(4.0 * moved[k] / thin, 200.0)) + 2)[:, None]
        path = [
            (axes[k] + shares[..., None] * (axes[k + 1] - axes[k]), p[k] + shares * (p[k + 1] - p[k]))
            for axes, p in cores
        ]
        apart, depths, _ = overlaps(rows, path)
        for beside, along, least in zip(apart, depths[:, :-1], depths.min(axis=1), strict=True):
            if least <= 0.0 or last < k - 1:  # the line of centres, the last axis, has no sides
                axis = int(along.argmin())
                side, last = beside[axis], k
            elif least > thin and side * beside[axis] < 0.0:
                yield int(k), float(speed[k]), thin
                break
        last = k
