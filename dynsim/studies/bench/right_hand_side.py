"""One right-hand side of the published arm, with more and more links."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.dynamics import tables as ka
from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.simd.system import derivative_lanes
from dynsim.dynamics.simd.tables import as_lanes, tables_as_lanes
from dynsim.dynamics.state import block
from dynsim.engine.dynamics import Prepared, prepare
from dynsim.jit.kernel import kernel
from dynsim.scenario import load_scenario
from dynsim.studies.bench import mujoco_peer, pinocchio_peer
from dynsim.studies.bench.programs import (
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
from dynsim.studies.bench.timing import Timed, in_batches, one_by_one, take_turns

Array = NDArray[np.float64]

# Measured in Python calls, with the cost of the call taken off.
_CALLED_FROM_PYTHON = (CONSTRAINT_DYNAMICS, LCABA)
_PYTHON_ABA = "Pinocchio ABA, one Python call each"


@kernel
def repeat_derivative(system: System, y: Array, ws: ka.Workspace, dy: Array, count: int) -> float:
    """``count`` right-hand sides at slightly different states; returns a sum, so that none can be left out."""
    total = 0.0
    first = y[0]
    for k in range(count):
        y[0] = first + 1e-3 * (k & 7)
        derivative(system, 1e-3 * (k & 1023), y, ws, dy)
        total += dy[y.shape[0] - 1]
    y[0] = first
    return total


@kernel
def repeat_lanes(width: Any, system: System, y: Array, ws: ka.Workspace, dy: Array, count: int) -> None:
    """``count`` right-hand sides of all lanes."""
    for k in range(count):
        derivative_lanes(
            tables_as_lanes(system, width),  # type: ignore[call-arg]
            1e-3 * (k & 1023),
            as_lanes(y, width),  # type: ignore[call-arg]
            tables_as_lanes(ws, width),  # type: ignore[call-arg]
            as_lanes(dy, width),  # type: ignore[call-arg]
        )


def measure(n: int, rounds: int, share: float, *, with_pinocchio: bool, with_mujoco: bool) -> dict[str, list[float]]:
    """Seconds of every contender at ``n`` links, ``rounds`` samples of about ``share`` seconds each."""
    arms = {contacts: prepare(_arm(n, contacts)) for contacts in (False, True)}
    timed = [
        Timed(DYNSIM_FREE, _derivative_loop(arms[False])),
        Timed(DYNSIM_CONTACTS, _derivative_loop(arms[True])),
    ]
    if with_pinocchio:
        timed += _pinocchio_contenders(arms[True])
    if with_mujoco:
        timed += _mujoco_contenders(arms[True])
    return take_turns(timed, rounds, share)


def python_call_cost(samples: dict[str, list[float]]) -> float | None:
    """What a call from Python costs [s], None when these samples do not tell."""
    if _PYTHON_ABA not in samples or ABA not in samples:
        return None
    return max(0.0, float(np.median(samples[_PYTHON_ABA]) - np.median(samples[ABA])))


def row(n: int, samples: dict[str, list[float]], python_call: float) -> dict[str, Any]:
    """Microseconds of every contender at n links, Python calls taken off where the work is called from Python."""
    found: dict[str, Any] = {"links": n, "median_us": {}, "minimum_us": {}}
    for name, values in samples.items():
        if name == _PYTHON_ABA:
            continue
        off = python_call if name in _CALLED_FROM_PYTHON else 0.0
        found["median_us"][name] = 1e6 * (float(np.median(values)) - off)
        found["minimum_us"][name] = 1e6 * (float(np.min(values)) - off)
    return found


def _arm(n: int, contacts: bool) -> Any:
    """The published arm with n links: links beyond the tenth are copies, bent to and fro, and all hold still."""
    overrides: dict[str, Any] = {}
    if n != 10:
        angles = load_scenario(SCENARIO).plant.initial_deg
        overrides = {
            "plant.chain.1.count": n - 1,
            "plant.initial_deg": [*angles, *([30, -30] * n)][:n],
            "controller.hand": None,
        }
    return load_scenario(SCENARIO, "two_elbows" if contacts else "no_elbow", overrides)


def _derivative_loop(prepared: Prepared) -> Callable[[int], int]:
    y, ws = prepared.run.y.copy(), prepared.workspace
    y[block(prepared.run.layout, "v")] = 0.1  # slipping, turning: no term is zero
    dy = np.zeros_like(y)

    def call(count: int) -> int:
        repeat_derivative(prepared.system, y, ws, dy, count)
        return count

    call(1)
    return call


def _pinocchio_contenders(prepared: Prepared) -> list[Timed]:
    import pinocchio

    model = pinocchio_peer.build_pinocchio(prepared.system.model)
    q, v = prepared.model.robot.initial, np.full(prepared.model.n, 0.1)
    links = [int(link) for link in prepared.system.contacts.link[:, ka.LINK]]
    data = model.createData()
    timed = [Timed(_PYTHON_ABA, one_by_one(pinocchio_peer.python_aba(model, data, q, v)))]
    if hasattr(pinocchio, "abaInParallel"):
        batch = max(2, 3000 // prepared.model.n)
        timed.insert(0, Timed(ABA, in_batches(pinocchio_peer.native_aba(model, q, v, batch), batch)))
    for algorithm, name in (("constraintDynamics", CONSTRAINT_DYNAMICS), ("lcaba", LCABA)):
        if hasattr(pinocchio, algorithm):
            timed.append(Timed(name, one_by_one(pinocchio_peer.constrained(model, data, algorithm, links, q, v))))
    return timed


def _mujoco_contenders(prepared: Prepared) -> list[Timed]:
    timed = []
    for name, contacts in ((MUJOCO_FREE, "none"), (MUJOCO_CONTACTS, "soft")):
        model = mujoco_peer.build_mujoco(prepared.system, step=STEP, motors=False, contacts=contacts)  # type: ignore[arg-type]
        steps = 5
        batch = max(1, 20_000 // prepared.model.n**2)
        call = mujoco_peer.steps_call(model, prepared.model.robot.initial, batch, steps)
        timed.append(Timed(name, in_batches(call, batch * steps)))
    return timed
