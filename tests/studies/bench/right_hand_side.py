"""Benchmark of one right-hand side of the published arm, for growing numbers of links."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from statistics import median
from timeit import Timer
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.dynamics import tables as ka
from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.state import block
from dynsim.engine.simulation import Prepared, prepare
from dynsim.jit.kernel import kernel
from dynsim.scenario import load_scenario
from studies.bench import mujoco_peer, pinocchio_peer
from studies.bench.programs import (
    ABA,
    CONSTRAINT_DYNAMICS,
    DYNSIM_CONTACTS,
    DYNSIM_FREE,
    LCABA,
    MUJOCO_CONTACTS,
    MUJOCO_FREE,
    SCENARIO,
    STEP,
)

Array = NDArray[np.float64]
Contender = tuple[Callable[[], Any], int]
"""A call, and its number of evaluations."""

# Memory of Pinocchio's Data grows with the square of the number of links: 0.85 GB at 300.
PINOCCHIO_LINKS_MAX = 300
_PYTHON_ABA = "Pinocchio ABA, one Python call each"


@kernel
def repeat_derivative(system: System, y: Array, ws: ka.Workspace, dy: Array, count: int) -> float:
    """Evaluate ``count`` right-hand sides at slightly different states; return a sum, so that none is omitted."""
    total = 0.0
    first = y[0]
    for k in range(count):
        y[0] = first + 1e-3 * (k & 7)
        derivative(system, 1e-3 * (k & 1023), y, ws, dy)
        total += dy[y.shape[0] - 1]
    y[0] = first
    return total


def measure(
    sizes: Sequence[int], rounds: int, share: float, *, with_mujoco: bool, with_pinocchio: bool
) -> list[dict[str, Any]]:
    """Return median microseconds by links and program, over ``rounds`` samples of about ``share`` seconds each."""
    rows, python_call = [], 0.0
    for n in sizes:
        arms = {contacts: prepare(_arm(n, contacts)) for contacts in (False, True)}
        contenders = {DYNSIM_FREE: _derivative_loop(arms[False]), DYNSIM_CONTACTS: _derivative_loop(arms[True])}
        if with_pinocchio and n <= PINOCCHIO_LINKS_MAX:
            contenders |= _pinocchio_contenders(arms[True])
        if with_mujoco:
            contenders |= _mujoco_contenders(arms[True])
        # The cost of a call from Python does not depend on the size; it is measured best with the least work.
        if n != sizes[0]:
            contenders.pop(_PYTHON_ABA, None)
        seconds = {name: median(samples) for name, samples in take_turns(contenders, rounds, share).items()}
        if n == sizes[0] and with_pinocchio:
            python_call = max(0.0, (called := seconds.pop(_PYTHON_ABA)) - seconds.get(ABA, called))
        for name in seconds.keys() & {CONSTRAINT_DYNAMICS, LCABA}:
            seconds[name] -= python_call
        rows += [{"links": n, "program": name, "median_us": 1e6 * value} for name, value in seconds.items()]
    return rows


def take_turns(contenders: dict[str, Contender], rounds: int, share: float) -> dict[str, list[float]]:
    """Return seconds per unit of work of every contender, one sample per round, the contenders interleaved.

    CPU time of this thread, in which all of them run: time of other processes does not count.
    """
    timers = {name: Timer(call, timer=time.thread_time) for name, (call, _) in contenders.items()}
    # The first calls warm the caches.
    calls = {name: max(1, int(share / min(timer.repeat(4, 1)))) for name, timer in timers.items()}
    samples: dict[str, list[float]] = {name: [] for name in timers}
    for k in range(rounds):
        for name, timer in timers.items():
            units = calls[name] * contenders[name][1]
            # A contender that takes much longer than a sample should gets fewer samples.
            if k < 3 or sum(samples[name]) * units < 4.0 * rounds * share:
                samples[name].append(timer.timeit(calls[name]) / units)
    return samples


def _arm(n: int, contacts: bool) -> Any:
    """Return the published arm with n links, all stationary; links beyond the tenth are copies, bent alternately."""
    overrides: dict[str, Any] = {}
    if n != 10:
        angles = load_scenario(SCENARIO).plant.initial_deg
        overrides = {
            "plant.chain.1.count": n - 1,
            "plant.initial_deg": [*angles, *([30, -30] * n)][:n],
            "controller.hand": None,
        }
    return load_scenario(SCENARIO, "two_elbows" if contacts else "no_elbow", overrides)


def _derivative_loop(prepared: Prepared) -> Contender:
    y, ws = prepared.run.y.copy(), prepared.workspace
    y[block(prepared.run.layout, "v")] = 0.1  # slipping, turning: no term is zero
    dy, count = np.zeros_like(y), max(2, 3000 // prepared.model.n)
    return lambda: repeat_derivative(prepared.system, y, ws, dy, count), count


def _pinocchio_contenders(prepared: Prepared) -> dict[str, Contender]:
    import pinocchio

    model = pinocchio_peer.build_pinocchio(prepared.system.model)
    q, v = prepared.model.robot.initial, np.full(prepared.model.n, 0.1)
    links = [int(link) for link in prepared.system.contacts.link[:, ka.LINK]]
    data, batch = model.createData(), max(2, 3000 // prepared.model.n)
    contenders: dict[str, Contender] = {
        _PYTHON_ABA: (pinocchio_peer.python_aba(model, data, q, v), 1),
        CONSTRAINT_DYNAMICS: (pinocchio_peer.constrained(model, data, "constraintDynamics", links, q, v), 1),
        LCABA: (pinocchio_peer.constrained(model, data, "lcaba", links, q, v), 1),
    }
    # Not if Pinocchio is built without threads.
    if hasattr(pinocchio, "abaInParallel"):
        contenders[ABA] = pinocchio_peer.native_aba(model, q, v, batch), batch
    return contenders


def _mujoco_contenders(prepared: Prepared) -> dict[str, Contender]:
    contenders, steps = {}, 5
    for name, contacts in ((MUJOCO_FREE, "none"), (MUJOCO_CONTACTS, "soft")):
        model = mujoco_peer.build_mujoco(prepared.system, step=STEP, motors=False, contacts=contacts)  # type: ignore[arg-type]
        batch = max(1, 20_000 // prepared.model.n**2)
        call = mujoco_peer.steps_call(model, prepared.model.robot.initial, batch, steps)
        contenders[name] = call, batch * steps
    return contenders
