"""Linearization of the coupled system about a state, with fixed contact modes.

    δẋ = A δx + B δu,   δy = C δx + D δu,   x = (q, v, i)

Bodies, motors with their controller, loads and active constraints form one right-hand side. The present contact modes
are kept, so the equations are valid until the next event. A sampled controller is replaced by the continuous controller
with the same control law. The loop is therefore closed, and sampling effects are neglected. Constraints enter A at the
acceleration level: each active row adds two zero eigenvalues, for motions that violate the constraint and do not occur
in the simulation.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.hand_posture import angular_jacobian
from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.derivative import derivative
from dynsim.dynamics.drive.law import asked_of
from dynsim.dynamics.state import block
from dynsim.dynamics.tree import loads as kl
from dynsim.engine.prepare import Prepared
from dynsim.engine.stopping import copied
from dynsim.errors import ScenarioError, brief
from dynsim.integrators import run as ki
from dynsim.integrators.run import fill_output

Array = NDArray[np.float64]
# Steps of the finite differences [rad, m, rad/s, A, …]. The largest have the smallest rounding errors; the smallest are
# below the speeds over which friction is smoothed.
STEPS = tuple(1e-2 / 3.0**k for k in range(9))
# Rows whose largest entry is below this count as zero [SI units].
ZERO_ROW = 1e-6
MODES = {ka.OPEN: "open", ka.SLIDING: "sliding", ka.STICKING: "sticking"}
_AXES = "xyz"
# Singular value of the response to forces, per unit of kinetic energy, above which a direction is free. Constraints
# project the response of unconstrained bodies, so that the values are 0 or at least 1.
FREE = 0.5
# Largest part of the rates of a free motion, per unit of kinetic energy, that leaves the free directions, relative to
# these rates; rates below 1/s or 1/s² count as 1.
TURNING = 1e-4


@dataclass(frozen=True)
class Linearization:
    """Linear equations about a state; unpack with ``A, B, C, D = linearization``.

    Attributes
    ----------
    A : (x, x) ndarray
        State matrix.
    B : (x, u) ndarray
        Input matrix.
    C : (y, x) ndarray
        Output matrix.
    D : (y, u) ndarray
        Feedthrough matrix.
    states, inputs, outputs : tuple of str
        Names of the states, inputs and outputs, in the order of rows and columns.
    time : float
        Time of the linearization [s].
    x : (x,) ndarray
        State about which the system is linearized.
    xdot : (x,) ndarray
        Time derivative of the state; zero only in an equilibrium.
    modes : dict of str to str
        Mode of each contact point: open, sliding or sticking; under the bilateral law all points slide.
    error : float
        Estimated error of the least accurate entry, relative to the largest entry of its row; accurate to a factor of
        about ten.
    basis : (x, z) ndarray or None
        Free directions of a reduced system, whose state z describes x = x₀ + basis z; None for the whole state.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    time: float
    x: Array
    xdot: Array
    modes: dict[str, str] = field(default_factory=dict)
    error: float = 0.0
    basis: Array | None = None

    @cached_property
    def _projection(self) -> Array:
        """Pseudo-inverse of the basis, (z, x); a controller needs it at each of its ticks."""
        assert self.basis is not None
        return np.asarray(np.linalg.pinv(self.basis))

    def reduced_state(self, x: Array) -> Array:
        """Return the state z of a reduced system, (z,), for a state x, (x,), with the least distance from it."""
        return np.asarray(self._projection @ (np.asarray(x) - self.x))

    def __iter__(self) -> Iterator[Array]:
        return iter((self.A, self.B, self.C, self.D))


def linearized(prepared: Prepared, inputs: Sequence[str], outputs: Sequence[str], reduced: bool) -> Linearization:
    """Linearize a run at its present state and time, see :meth:`dynsim.Simulation.linearize`."""
    frozen = _Frozen(prepared)
    entries = _selected("input", inputs, frozen.inputs())
    columns = _selected("output", outputs, frozen.outputs())
    read = np.array(list(columns.values()), dtype=int)
    n, x = len(frozen.x), frozen.x
    by_x, error_x = _jacobian(lambda d: frozen.rate_and_output(x + d, read), n)
    parts = [_jacobian(partial(entry, read), 1) for entry in entries.values()]
    by_u = np.hstack([np.zeros((n + len(read), 0)), *(part for part, _ in parts)])
    robot = prepared.model.robot
    circuits = [m.joint for a, m in enumerate(robot.motors) if prepared.system.drives.table[a, ka.CIRCUIT] >= 0]
    names = [("q", robot.position_names), ("v", robot.joint_names), ("current", circuits)]
    states = tuple(f"{kind}.{label}" for kind, labels in names for label in labels)
    basis = _free_states(frozen, by_x[:n], len(robot.position_names), len(robot.joint_names)) if reduced else None
    if basis is not None:
        left, count = np.linalg.pinv(basis), (basis.shape[1] - len(circuits)) // 2
        states = tuple(f"{kind}.free_{k}" for kind in ("q", "v") for k in range(1, count + 1))
        states += tuple(f"current.{joint}" for joint in circuits)
        by_x = np.vstack([left @ by_x[:n], by_x[n:]]) @ basis
        by_u = np.vstack([left @ by_u[:n], by_u[n:]])
    order = len(states)
    return Linearization(
        A=by_x[:order],
        B=by_u[:order],
        C=by_x[order:],
        D=by_u[order:],
        states=states,
        inputs=tuple(entries),
        outputs=tuple(columns),
        time=frozen.time,
        x=x,
        xdot=frozen.rate_and_output(x, read)[:n],
        modes={
            contact.name: MODES[int(prepared.workspace.active[k, ka.MODE])]
            for k, contact in enumerate(prepared.contacts)
        },
        error=max([error_x, *(error for _, error in parts)]),
        basis=basis,
    )


def _free_states(frozen: _Frozen, A: Array, n_q: int, n_v: int) -> Array:
    """Return a basis, (x, z), of the states that the active constraints leave free: free motions, and all currents.

    Forces on the bodies accelerate them in the free directions only, whatever blocks the others: contacts, stops,
    couplings, joints at rest by friction.

    Raises
    ------
    ScenarioError
        If the free directions turn so fast that the equations leave them.
    """
    from scipy.linalg import block_diag, qr  # imported here because it loads slowly

    inputs, nothing = frozen.inputs(), np.zeros(0, dtype=int)
    pushes = [*inputs["force"].values(), *inputs["torque"].values()]
    # With fixed modes accelerations are linear in the forces, so one difference is exact.
    rates = [0.5 * (push(nothing, np.ones(1)) - push(nothing, -np.ones(1))) for push in pushes]
    factor, forces = frozen.inertia_and_forces(n_q)
    # In the coordinates Lᵀ v with M = L Lᵀ, bodies without constraints respond to a unit force with a unit rate. Light
    # and heavy bodies then have the same scale.
    inverse = np.stack(rates, axis=1)[n_q : n_q + n_v] @ np.linalg.pinv(forces)
    response = factor.T @ inverse @ factor
    count = int((np.linalg.svd(response, compute_uv=False) > FREE).sum())
    _, _, pivots = qr(response, pivoting=True)
    free, _ = np.linalg.qr(np.linalg.solve(factor.T, response[:, pivots[:count]]))
    transmission = A[:n_q, n_q : n_q + n_v]
    motion = block_diag(transmission @ free, free)
    basis = block_diag(motion, np.eye(len(A) - n_q - n_v))
    moved = A[: len(motion)] @ basis[:, : 2 * count]
    leaving = moved - motion @ (np.linalg.pinv(motion) @ moved)
    weight = block_diag(factor.T @ np.linalg.pinv(transmission), factor.T)
    energy = np.linalg.norm(weight @ motion, axis=0)
    left, moved = (np.linalg.norm(weight @ table, axis=0) / energy for table in (leaving, moved))
    if (left > TURNING * np.maximum(moved, 1.0)).any():
        raise ScenarioError(
            "Simulation.linearize: reduced=True requires a state near rest; here the directions that the contacts "
            "leave free turn too fast; advance to an instant at which the robot rests"
        )
    return basis


class _Frozen:
    """Right-hand side of a run at one instant, with fixed contact modes, and its outputs."""

    def __init__(self, prepared: Prepared) -> None:
        self._prepared = prepared
        run = prepared.run
        self.time = float(run.clock[ki.TIME])
        self._system, self._workspace, self._y = copied(prepared.system), copied(prepared.workspace), run.y.copy()
        self._tracked = run.layout.tracked
        # Commands held from tick to tick would leave the loop open; commands that the caller set stay held.
        table = self._system.drives.table
        table[table[:, ka.SAMPLED] == ka.AT_TICKS, ka.SAMPLED] = ka.CONTINUOUS
        self.x = self._y[: self._tracked].copy()
        self._evaluate(self.x, self._system)
        drives, reference = self._system.drives, self._system.reference
        motors = range(len(drives.table))
        self._asked = [float(asked_of(drives, reference, self.time, self._latest, a)) for a in motors]
        self._references = self._latest.motors[:, [ka.Q_REF, ka.V_REF]].copy()

    def rate_and_output(self, x: Array, read: NDArray[Any], system: Any = None) -> Array:
        """Return dx/dt, followed by the states and recorded columns with the indices ``read``."""
        dy = self._evaluate(x, self._system if system is None else system)
        if not len(read):
            return dy
        run = self._prepared.run
        out = np.zeros(run.columns.size)
        fill_output(self._system if system is None else system, self._latest, run, out)
        return np.concatenate([dy, np.concatenate([x, out])[read]])

    def _evaluate(self, x: Array, system: Any) -> Array:
        y, dy = self._y.copy(), np.zeros(len(self._y))
        y[: self._tracked] = x
        # Friction signs, anchors and counters must not change between evaluations.
        self._latest = copied(self._workspace)
        derivative(system, self.time, y, self._latest, dy)
        return dy[: self._tracked]

    def inertia_and_forces(self, n_q: int) -> tuple[Array, Array]:
        """Return the Cholesky factor of the mass matrix, (n, n), and the joint forces of all pushes, (n, 6 bodies)."""
        model, q = self._prepared.model, self.x[:n_q]
        # A closed brake counts as a constraint, not as inertia.
        armature = np.where(model.armature == ka.BRAKED, 1.0, model.armature)
        forces, torques = list[Array](), list[Array]()
        for body in model.robot.bodies:
            forces.append(model.point_jacobian(body, np.zeros(3), q).T)
            torques.append(angular_jacobian(model, body, model.body_pose(body, q)[0], q).T)
        return np.linalg.cholesky(model.mass_matrix(q) + np.diag(armature)), np.hstack(forces + torques)

    def inputs(self) -> dict[str, dict[str, Callable[[NDArray[Any], Array], Array]]]:
        """Return all inputs by family and label, as functions of the outputs to read and of the change, (1,)."""
        joints = [motor.joint for motor in self._prepared.model.robot.motors]
        bodies = self._prepared.model.robot.bodies
        first = len(self._prepared.loads) - len(bodies)

        def moved(change: Callable[..., None], *indices: int) -> Callable[[NDArray[Any], Array], Array]:
            def at(read: NDArray[Any], amount: Array) -> Array:
                system = copied(self._system)
                change(system, float(amount[0]), *indices)
                return self.rate_and_output(self.x, read, system)

            return at

        def command(system: Any, amount: float, a: int) -> None:
            system.drives.table[a, ka.SAMPLED] = ka.GIVEN
            system.drives.input[a, ka.COMMAND] = self._asked[a] + amount

        def reference(system: Any, amount: float, a: int, rate: int) -> None:
            line = self._references[a].copy()
            line[rate] += amount
            system.reference.spline[a] = ka.REWRITTEN
            system.drives.input[a, [ka.LINE_START, ka.LINE_RATE, ka.LINE_SINCE]] = *line, self.time

        def push(system: Any, amount: float, k: int, component: int) -> None:
            start = system.loads.table[first + k, kl.DATA]
            system.loads.data[start + kl.WRENCH + component] += amount

        motors = list(enumerate(joints))
        pushes = [(k, body, axis) for k, body in enumerate(bodies) for axis in range(3)]
        return {
            "command": {joint: moved(command, a) for a, joint in motors},
            "reference": {joint: moved(reference, a, 0) for a, joint in motors},
            "reference_rate": {joint: moved(reference, a, 1) for a, joint in motors},
            "force": {f"{body}.{_AXES[axis]}": moved(push, k, axis) for k, body, axis in pushes},
            "torque": {f"{body}.{_AXES[axis]}": moved(push, k, 3 + axis) for k, body, axis in pushes},
        }

    def outputs(self) -> dict[str, dict[str, int]]:
        """Return all outputs by family and label, as indices into the states followed by the recorded columns."""
        run, robot = self._prepared.run, self._prepared.model.robot
        columns, beyond = run.columns, run.layout.tracked
        motors = [motor.joint for motor in robot.motors]
        contacts = [contact.name for contact in self._prepared.contacts]

        def numbered(labels: Sequence[str], first: int) -> dict[str, int]:
            return {label: first + k for k, label in enumerate(labels)}

        def of_contacts(offset: int) -> dict[str, int]:
            first = beyond + columns.contact + offset
            return {name: first + kst.OUTPUTS_PER_CONTACT * k for k, name in enumerate(contacts)}

        force = of_contacts(kst.OUT_VECTOR)
        return {
            "q": numbered(robot.position_names, block(run.layout, "q").start),
            "v": numbered(robot.joint_names, block(run.layout, "v").start),
            "current": numbered(motors, beyond + columns.current),
            "vdot": numbered(robot.joint_names, beyond + columns.vdot),
            "voltage": numbered(motors, beyond + columns.voltage),
            "motor_torque": numbered(motors, beyond + columns.torque),
            "hand_position": numbered(_AXES, beyond + columns.hand),
            "contact_normal_force": of_contacts(kst.OUT_FORCE),
            "contact_force": {f"{name}.{_AXES[s]}": at + s for name, at in force.items() for s in range(3)},
            "contact_gap": of_contacts(kst.OUT_GAP),
        }


def _selected(kind: str, names: Sequence[str], families: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the entries that match the names: a whole family, all entries of a body or point, or a single entry."""
    if isinstance(names, str):
        names = (names,)
    chosen: dict[str, Any] = {}
    every = {f"{family}.{label}": entry for family, labels in families.items() for label, entry in labels.items()}
    for name in names:
        meant = {full: entry for full, entry in every.items() if full == name or full.startswith(f"{name}.")}
        chosen |= meant
        if not meant and name not in families:
            near = difflib.get_close_matches(str(name), every, 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise ScenarioError(
                f"unknown {kind} {brief(name)}{hint}; use a family ({', '.join(families)}) or a member, such as "
                f"{next(iter(every))!r}"
            )
    return chosen


def _jacobian(function: Callable[[Array], Array], size: int) -> tuple[Array, float]:
    """Return the derivative of a function at zero, (m, size), and the largest difference between two estimates.

    The estimates are sixth-order central differences with several step sizes. Each entry uses the estimate that differs
    least from the estimates of the adjacent step sizes, similar to Ridders' method. (:mod:`scipy.differentiate` halves
    the step until the relative change of an entry is small. An entry of zero never gets there, so the steps end in
    rounding errors.)
    """
    estimates = []
    for step in STEPS:
        columns = []
        for direction in step * np.eye(size):
            ends = [function(k * direction) - function(-k * direction) for k in (1, 2, 3)]
            columns.append((45.0 * ends[0] - 9.0 * ends[1] + ends[2]) / (60.0 * step))
        estimates.append(np.stack(columns, axis=1))
    every = np.stack(estimates)
    changes = np.abs(np.diff(every, axis=0))
    # The change between two step sizes may be small by chance, so use the larger of two changes.
    changes = np.maximum(changes[:-1], changes[1:])
    best = changes.argmin(axis=0)[None]
    slope, change = (np.take_along_axis(table, best, axis=0)[0] for table in (every[1:-1], changes))
    largest = np.abs(slope).max(axis=1, initial=ZERO_ROW, keepdims=True)
    return slope, float((change / largest).max(initial=0.0))
