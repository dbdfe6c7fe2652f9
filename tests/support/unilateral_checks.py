"""Random robots that touch surfaces, and the checks of the unilateral law at every sample."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dynsim.compile.model import Model
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.state import (
    CONSTRAINT,
    ELECTRICAL,
    FRICTION,
    GEAR,
    JOINT,
    JOULE,
    OUT_FORCE,
    OUT_GAP,
    OUT_MODE,
    OUT_SLIP,
    OUT_VECTOR,
)
from dynsim.integrators import run as ki
from dynsim.integrators.contacts import events as ke
from dynsim.model.description import Contact, Quadric
from support.random_robots import CompiledSystem, assemble, random_contacts, random_positions, random_robot


def raised(contact: Contact, height: float) -> Contact:
    """Return the contact with its surface moved away from its point by a height [m], along the normal there."""
    surface = contact.surface
    assert isinstance(surface, Quadric)
    if not surface.Q.any():
        return replace(contact, surface=replace(surface, c=surface.c + height))
    # C = r·Q r/2 + b·r + c with Q a projection: the radius shrinks.
    centre = -np.linalg.lstsq(surface.Q, surface.b, rcond=None)[0]
    radius = np.sqrt(float(centre @ surface.Q @ centre) - 2.0 * surface.c) - height
    return replace(contact, surface=replace(surface, c=0.5 * (float(centre @ surface.Q @ centre) - radius**2)))


def random_touch(seed: int) -> tuple[CompiledSystem, np.ndarray]:
    """Return a random robot with two to six contacts, on their surfaces or some centimetres off, and a state."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 9))
    robot = random_robot(rng, n, branches=bool(rng.random() < 0.5), motors=bool(rng.random() < 0.5))
    q = 0.5 * random_positions(rng, robot)
    contacts = []
    for contact in random_contacts(rng, robot, q, int(rng.integers(2, 7))):
        mu = rng.uniform(0.0, 0.8)
        changed = replace(
            contact,
            friction=mu,
            pulling_friction="signed",
            static_friction=mu * rng.uniform(1.0, 1.5) if rng.random() < 0.4 else mu,
            stribeck=rng.uniform(0.01, 0.1) if rng.random() < 0.3 else 0.0,
            viscous_friction=rng.uniform(0.0, 0.1) if rng.random() < 0.3 else 0.0,
            restitution=rng.uniform(0.0, 0.8) if rng.random() < 0.2 else 0.0,
        )
        contacts.append(raised(changed, rng.uniform(0.0, 0.1)) if rng.random() < 0.5 else changed)
    v = 0.3 * rng.normal(size=n) if rng.random() < 0.5 else np.zeros(n)
    b = assemble(robot, contacts, real=True, held=q[[robot.joint_names.index(m.joint) for m in robot.motors]])
    return b, b.state(q, v)


def ledger_residual(run: ki.Run) -> np.ndarray:
    """Return the unexplained part of the ledger at each sample, relative to the turnover [1]."""
    stored, ledger, loss = run.outputs("energy").sum(axis=1), run.states("ledger"), run.states("loss").sum(axis=1)
    spent = ledger[:, [JOULE, GEAR, JOINT, FRICTION]].sum(axis=1) + loss
    # An impact at the start precedes the first sample.
    off = stored - stored[0] + spent - spent[0] - ledger[:, ELECTRICAL] - ledger[:, CONSTRAINT]
    return off / (1.0 + np.abs(stored).max() + spent.max() + np.abs(ledger[:, ELECTRICAL]).max())


def violations(b: CompiledSystem, run: ki.Run) -> dict[str, float]:
    """Return the worst violation of each rule over all samples; forces relative to the largest of a sample plus 1 N.

    Units: 1, m. Rules: f_n ≥ 0; gap ≥ 0; f_n gap = 0; |f_t| ≤ μ f_n; sliding friction is μ f_n against slip.
    """
    touch = run.outputs("contact")
    mode, f, gap = touch[:, :, OUT_MODE], touch[:, :, OUT_FORCE], touch[:, :, OUT_GAP]
    scale = 1.0 + np.abs(f).max(axis=1, keepdims=True)
    worst = {
        "pull": float((-f / scale).max()),
        "depth": float(max((-gap).max(), b.system.unilateral.tally[:, ku.DEEPEST].max())),
        "product": float(np.abs(f * gap / scale).max()),
        "cone": 0.0,
        "against slip": 0.0,
        "slip of what sticks": 0.0,
        "ledger": float(np.abs(ledger_residual(run)).max()),
    }
    for k, contact in enumerate(b.contacts):
        static, stribeck = b.system.contacts.law[k, [ka.STATIC, ka.STRIBECK]]
        for s in range(len(touch)):
            if mode[s, k] == ka.OPEN:
                assert f[s, k] == 0.0
                continue
            force, slip = touch[s, k, OUT_VECTOR : OUT_VECTOR + 3], touch[s, k, OUT_SLIP : OUT_SLIP + 3]
            q = run.states("q")[s]
            normal = _normal(b, contact, q)
            # A frozen slip direction is tangential at the ends of steps; within a step a curved surface turns.
            assert abs(force @ normal - f[s, k]) <= 1e-5 * scale[s, 0]
            tangential, speed = force - f[s, k] * normal, float(np.linalg.norm(slip))
            if mode[s, k] == ka.STICKING:
                cone = (float(np.linalg.norm(tangential)) - static * f[s, k]) / scale[s, 0]
                worst["cone"] = max(worst["cone"], cone)
                worst["slip of what sticks"] = max(worst["slip of what sticks"], speed)
            elif speed > 1e-4:
                mu = contact.friction + contact.viscous_friction * speed
                if stribeck > 0.0:
                    mu += (static - contact.friction) * np.exp(-((speed / stribeck) ** 2))
                off = float(np.linalg.norm(tangential + mu * f[s, k] * slip / speed)) / scale[s, 0]
                worst["against slip"] = max(worst["against slip"], off)
    return worst


def _normal(b: CompiledSystem, contact: Contact, q: np.ndarray) -> np.ndarray:
    position = Model(b.robot).point_position(contact.body, contact.point, q)
    slope = contact.surface.Q @ position + contact.surface.b
    return slope / np.linalg.norm(slope)


def events(run: ki.Run) -> list[tuple[float, int, int]]:
    """Return time, contact and kind of the logged contact events."""
    events_seen = []
    for t, code in zip(run.log_time, run.log_event[: run.count[ki.LOGGED]], strict=False):
        k, kind = divmod(int(code) - ki.CONTACT_LOG, ke.LOG_KINDS)
        events_seen.append((float(t), k, kind))
    return events_seen
