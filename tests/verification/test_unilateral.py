"""Real contact in closed form: blocks on slopes, bouncing balls, discs, rods, joint stops."""

from __future__ import annotations

import numpy as np
import pytest
from random_robots import Bench, bench

from dynsim.kernels import arrays as ka
from dynsim.kernels.integrate import contact_events as ce
from dynsim.kernels.integrate import run as ki
from dynsim.kernels.state import FRICTION, OUT_FORCE, OUT_GAP, OUT_MODE
from dynsim.model.description import Contact, Inertia, Link, Quadric, Robot, vector

G = 9.81


def plane(normal: np.ndarray, point: np.ndarray = np.zeros(3)) -> Quadric:
    return Quadric(np.zeros((3, 3)), normal, -float(normal @ point))


def block(mass: float) -> Robot:
    """A body that can go anywhere and does not turn."""
    links = []
    for k, name in enumerate("xyz"):
        inertia = Inertia(mass if name == "z" else 0.0)
        links.append(Link(name, f"joint_{name}", "wxyz"[k] if k else None, "prismatic", np.eye(3)[k], inertia))
    return Robot("block", tuple(links), (), ("z", np.zeros(3)))


def happened(run: ki.Run) -> list[tuple[float, int, int]]:
    """Time, contact and kind of the logged events of contacts."""
    found = []
    for t, code in zip(run.log_time, run.log_event[: run.count[ki.LOGGED]], strict=False):
        k, kind = divmod(int(code) - ki.CONTACT_LOG, ce.LOG_KINDS)
        found.append((float(t), k, kind))
    return found


def residual(b: Bench, run: ki.Run) -> float:
    """What the ledger of a passive system without losses of joints does not explain [J]."""
    stored = run.outputs("energy").sum(axis=1)
    taken = run.states("ledger")[:, FRICTION] + run.states("loss").sum(axis=1)
    return float(np.abs(stored - stored[0] + taken).max())


def sloped(alpha: float, mu: float, **law: float) -> Bench:
    normal = np.array([np.sin(alpha), 0.0, np.cos(alpha)])
    return bench(block(3.0), [Contact("foot", "z", vector(0.1, -0.2, 0.0), plane(normal, vector(0.1, -0.2, 0.0)),
                                      friction=mu, pulling_friction="signed", **law)], real=True)


@pytest.mark.parametrize("method", ["rk43", "dopri5", "rk4", "rodas4"])
@pytest.mark.parametrize("mu", [0.3, 0.5])
def test_a_block_on_a_slope_rests_or_slides(method, mu):
    alpha = np.arctan(0.4)
    b = sloped(alpha, mu)
    run = b.simulate(b.state(np.zeros(3), np.zeros(3)), np.linspace(0.0, 2.0, 5), method, step=1e-2 if method == "rk4" else 0.0)
    a = max(0.0, G * (np.sin(alpha) - mu * np.cos(alpha)))
    downhill = np.array([np.cos(alpha), 0.0, -np.sin(alpha)])
    way = 0.5 * a * run.sample_time[:, None] ** 2 * downhill
    np.testing.assert_allclose(run.states("q"), way, rtol=0, atol=1e-10)
    touch = run.outputs("contact")[:, 0]
    np.testing.assert_allclose(touch[:, OUT_FORCE], 3.0 * G * np.cos(alpha), rtol=1e-9)
    assert (touch[:, OUT_MODE] == (ka.SLIDING if mu < 0.4 else ka.STICKING)).all()
    assert np.abs(touch[:, OUT_GAP]).max() <= 1e-9
    assert residual(b, run) < 1e-8
