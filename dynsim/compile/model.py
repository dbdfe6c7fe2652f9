"""The rigid-body model for use from Python: one method per quantity, numpy in and out."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dynsim.compile.bracing import Brace, BraceStatics, PreparedBraces
from dynsim.compile.derivatives import InverseDynamicsDerivatives, inverse_dynamics_derivatives
from dynsim.compile.hand_posture import hand_posture
from dynsim.compile.tables import compile_model
from dynsim.config.problems import listed
from dynsim.dynamics import ledger
from dynsim.dynamics import tables as ka
from dynsim.dynamics.tree import articulated, joints, sweep
from dynsim.errors import ModelError, brief
from dynsim.model.description import Array, Contact, Robot
from dynsim.model.surfaces import Surface
from dynsim.record import record

_FLOAT64 = np.dtype(np.float64)


class Model:
    """Dynamics of a :class:`~dynsim.model.description.Robot`.

    ``M(q) v̇ + h(q, v) + g(q) = tau``: ``mass_matrix`` is M, ``bias_forces`` h + g. Rotor inertia, gear and joint losses
    and contacts are not part of these (they belong to motors and scenario); ``armature`` and ``damping`` give them.
    The wheels of a mobile base are part but for their spin, which is in ``armature`` as that of a rotor is.
    The masses of motors are: they sit on the links (:meth:`Robot.with_motors_mounted`).

    Parameters
    ----------
    robot : Robot

    Raises
    ------
    ModelError
        The description is not a physical tree of bodies.

    Every method raises ModelError for vectors of another length, for what is no finite number, and for unknown bodies.
    """

    def __init__(self, robot: Robot) -> None:
        if not isinstance(robot, Robot):
            raise ModelError(
                f"needs a Robot, not {brief(robot)}; Model.from_urdf(file) and build_model(scenario) give a model"
            )
        robot = robot.with_motors_mounted() if any(motor.mass for motor in robot.motors) else robot
        self.robot = robot
        self.arrays = compile_model(robot)
        self.n, self.nq = len(robot.links), robot.nq
        self._workspace = ka.workspace(self.n, 0, 0)
        self._q = np.zeros(self.nq)
        self._braces: PreparedBraces | None = None  # those of the last call of brace_statics
        self._position_names = robot.position_names  # computed from every link's kind
        # forward_dynamics and mass_matrix are those of the bodies alone: no rotor inertia.
        self._bodies = self.arrays._replace(body=self.arrays.body.copy())
        self._bodies.body[:, ka.ARMATURE] = 0.0

    def __repr__(self) -> str:
        robot = self.robot
        driven = [motor.joint for motor in robot.motors]
        motors = (
            "no motors" if not driven else "a motor on each" if len(driven) == self.n else f"motors on {listed(driven)}"
        )
        mass = sum(link.inertia.mass for link in robot.links)
        joints = f"joint{'s' if self.n > 1 else ''} {listed(self.joint_names)}"
        return f"<Model {robot.name}: {joints}, {motors}, hand on {robot.hand[0]}, {mass:.4g} kg>"

    def _repr_html_(self) -> str:
        robot = self.robot
        motors = {motor.joint for motor in robot.motors}
        head = ("body", "joint", "kind", "mass [kg]", "limits", "motor")
        rows = [
            (
                link.name,
                link.joint,
                link.kind,
                f"{link.inertia.mass:.4g}",
                f"{link.lower:.4g} … {link.upper:.4g}"
                if math.isfinite(link.lower) or math.isfinite(link.upper)
                else "",
                "yes" if link.joint in motors else "",
            )
            for link in robot.links
        ]
        return record.table(repr(self)[1:-1], [head, *rows])

    @classmethod
    def from_urdf(cls, path: str | os.PathLike[str], lock: Mapping[str, float] | None = None) -> Model:
        """Read bodies and joints from a URDF file (fixed joints are merged into their parents).

        Parameters
        ----------
        path : file
        lock : positions [rad or m] of joints that are to be fixed, by name

        Raises
        ------
        ModelError
            The message names file, line, link or joint and what to do; see :func:`dynsim.model.urdf.reader.read_urdf`.
        """
        from dynsim.model.urdf.reader import read_urdf

        if not isinstance(path, (str, os.PathLike)):
            raise ModelError(f"a URDF file is named by its path, not by {brief(path)}")
        return cls(read_urdf(Path(path), lock))

    def to_urdf(self) -> str:
        """The tree of bodies as URDF text, with masses, limits, viscous losses and shapes."""
        from dynsim.compile.scene import with_shapes
        from dynsim.model.urdf.writer import write_urdf

        return write_urdf(with_shapes(self.robot))

    def to_mjcf(self, contacts: Sequence[Contact] = (), surfaces: Mapping[str, Surface] | None = None) -> str:
        """The tree of bodies as MJCF, the format of MuJoCo, with what its motors add to it.

        Parameters
        ----------
        contacts : points that become sites
        surfaces : of which planes, spheres, cylinders and boxes become shapes that are drawn and do not touch

        Raises
        ------
        ModelError
            A joint of a kind that MJCF does not have, such as wheels that roll without slip.
        """
        from dynsim.compile.scene import drawn_surface, with_shapes
        from dynsim.model.mjcf import write_mjcf

        drawn = [drawn_surface(name, surface) for name, surface in (surfaces or {}).items()]
        return write_mjcf(with_shapes(self.robot), contacts, drawn, self.damping, self.armature)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in the order of v."""
        return self.robot.joint_names

    @property
    def geometry(self) -> ka.ModelArrays:
        """The tables without masses, inertias and losses: what poses of bodies follow from, beside q."""
        body = self.arrays.body.copy()
        body[:, ka.MASS : ka.PARAMETER] = 0.0
        return self.arrays._replace(body=body, gravity=np.zeros(3))

    @property
    def armature(self) -> Array:
        """What only turns with each joint: reflected rotor inertia J_m, spin of a wheel [kg m²], (n,)."""
        return self.arrays.body[:, ka.ARMATURE].copy()

    @property
    def damping(self) -> Array:
        """Viscous losses of each joint, D + D_m [N m s/rad], (n,)."""
        return self.arrays.body[:, ka.DAMPING] + self.arrays.body[:, ka.GEAR_DAMPING]

    @property
    def coupling_rows(self) -> Array:
        """Rows C of the couplings, C v = 0, (k, n)."""
        rows = np.zeros((len(self.robot.couplings), self.n))
        for row, coupling in zip(rows, self.robot.couplings, strict=True):
            row[self.joint_names.index(coupling.joint)] = 1.0
            row[self.joint_names.index(coupling.leader)] = -coupling.ratio
        return rows

    def mass_matrix(self, q: ArrayLike) -> Array:
        """M(q), (n, n) [kg m²] ([WM] eq 55)."""
        self._set(q)
        M = np.zeros((self.n, self.n))
        sweep.mass_matrix(self.arrays, self._workspace, M)
        return M

    def bias_forces(self, q: ArrayLike, v: ArrayLike) -> Array:
        """h(q, v) + g(q), (n,) [N m] ([WM] eq 54)."""
        self._set(q, v)
        sweep.newton_euler(self.arrays, self._workspace, 1.0, 0.0, 1.0)
        return self._workspace.joints[:, ka.BIAS].copy()

    def inverse_dynamics(self, q: ArrayLike, v: ArrayLike, vdot: ArrayLike) -> Array:
        """tau = M v̇ + h + g, (n,) [N m] ([WM] eqs 42–44)."""
        self._set(q, v)
        self._workspace.joints[:, ka.QDD] = self._vector(vdot, "vdot", self.joint_names)
        sweep.newton_euler(self.arrays, self._workspace, 1.0, 1.0, 1.0)
        return self._workspace.joints[:, ka.BIAS].copy()

    def forward_dynamics(self, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> Array:
        """v̇ = M⁻¹ (tau − h − g), (n,) [rad/s²], by the articulated sweeps."""
        self._set(q, v)
        self._workspace.joints[:, ka.APPLIED] = self._vector(tau, "tau", self.joint_names)
        articulated.forward_dynamics(self._bodies, self._workspace)
        return self._workspace.joints[:, ka.QDD].copy()

    def articulated_inertia(self, q: ArrayLike) -> Array:
        """Inertia that each joint moves while all joints behind it are free, rotors included, (n,) [kg m²; kg].

        Pivots of the mass matrix, by the articulated sweep. For a joint that moves no inertia the pivot is zero to
        rounding, and undefined for the joints before it.
        """
        self._set(q)
        self._workspace.joints[:, ka.APPLIED] = 0.0
        articulated.forward_dynamics(self.arrays, self._workspace)
        with np.errstate(divide="ignore"):
            return 1.0 / self._workspace.links[:, ka.INVERSE_D]

    def derivatives(self, q: ArrayLike, v: ArrayLike, vdot: ArrayLike) -> InverseDynamicsDerivatives:
        """Derivatives of inverse dynamics, ∂tau/∂q, ∂tau/∂v and ∂tau/∂v̇ = M, in closed form, (n, n) each.

        Those of forward dynamics follow, at v̇ = M⁻¹ (tau − h − g): ∂v̇/∂q = −M⁻¹ ∂tau/∂q, ∂v̇/∂v = −M⁻¹ ∂tau/∂v.
        Rotor inertia, losses and contacts are not part of them, as of all methods here;
        :meth:`dynsim.Simulation.linearize` has them all.
        """
        self.inverse_dynamics(q, v, vdot)
        return inverse_dynamics_derivatives(self.arrays, self._workspace.links)

    def brace_statics(self, q: ArrayLike, v: ArrayLike, vdot: ArrayLike, braces: Mapping[str, Brace]) -> BraceStatics:
        """Torques and brace forces that realise v̇ with the least heat, or a certificate that none do.

        tau = M v̇ + h + g + J_m v̇ + (D + D_m) v − J_cᵀ f,   minimise Σ R i², K_m i = tau

        over |f_t| ≤ μ f_n, f_n ≥ min_N (or f_n as commanded, or f_t against the slip), the limits of the motors at a
        steady current, and tau = 0 where there is none. The optimum uses friction as far as the cone allows; what a
        real brace takes is decided by its history. Torques are unique; of forces that no motor feels the split is one
        inside the cones.

        Parameters
        ----------
        q, v, vdot : (nq,), (n,), (n,)
        braces : by name, :class:`~dynsim.compile.bracing.Brace`

        Raises
        ------
        ModelError
            A brace on no body, without a direction, or with a force that pulls; a robot with coupled joints.
        """
        names = self.joint_names
        positions, rates = self._vector(q, "q", self._position_names), self._vector(v, "v", names)
        accelerations = self._vector(vdot, "vdot", names)
        if self._braces is None or not self._braces.are(braces):
            self._braces = PreparedBraces(self.robot, self.arrays, braces)
        return self._braces.solve(positions, rates, accelerations)

    def inverse_kinematics(
        self,
        target: ArrayLike,
        q: ArrayLike | None = None,
        *,
        orientation: ArrayLike | None = None,
        braces: Sequence[Contact] = (),
        tolerance: float = 1e-9,
    ) -> Array:
        """A posture near ``q`` that has the hand at ``target``, within the limits of the joints, (nq,).

        Damped Gauss–Newton steps of least change dq = Jᵀ (J Jᵀ + λ 1)⁻¹ e, λ falling with the error; joints at their
        limits leave the motion to the others.

        Parameters
        ----------
        target : (3,) of the hand [m]
        q : (nq,) to start from, which selects the branch; default: the initial posture
        orientation : (3, 3) rotation of the hand's body or frame in the world; default: any
        braces : points that are on their surfaces, see :func:`dynsim.scenario.build.contacts`
        tolerance : what may be left of position, gaps [m] and angles [rad]

        Raises
        ------
        UnreachableReference
            With what is left, and the joints that are at their limits.
        ModelError
            Joints of several coordinates, coupled joints, no rotation.
        """
        wanted = None
        if orientation is not None:
            wanted = np.array(_numbers(orientation, "orientation"))
            if wanted.shape != (3, 3) or not np.abs(wanted @ wanted.T - np.eye(3)).max() < 1e-6:
                raise ModelError("orientation must be a rotation, (3, 3)")
        start = self.robot.initial if q is None else self._vector(q, "q", self._position_names)
        return hand_posture(self, self._point(target), np.array(start), wanted, braces, tolerance)

    def point_position(self, body: str | int, point: ArrayLike, q: ArrayLike) -> Array:
        """World position of a point fixed on a body, or in a frame of one by its name, (3,) [m]."""
        index, on_body = self._attached(body, point)
        self._sweep(q)
        out = np.zeros(3)
        joints.point_position(self._workspace, index, on_body, out)
        return out

    def point_jacobian(self, body: str | int, point: ArrayLike, q: ArrayLike) -> Array:
        """Jacobian of a body-fixed point: its velocity in the world is J v, (3, n) [m/rad]."""
        return self.point_position_and_jacobian(body, point, q)[1]

    def point_position_and_jacobian(self, body: str | int, point: ArrayLike, q: ArrayLike) -> tuple[Array, Array]:
        """World position, (3,) [m], and its Jacobian, (3, n) [m/rad], from one sweep."""
        index, on_body = self._attached(body, point)
        position = self.point_position(index, on_body, q)
        jacobian = np.zeros((3, self.n))
        joints.point_jacobian(self.arrays, self._workspace, index, position, jacobian)
        return position, jacobian

    def body_pose(self, body: str | int, q: ArrayLike) -> tuple[Array, Array]:
        """Rotation R_WB, (3, 3), and origin p_WB, (3,) [m], of a body."""
        self._sweep(q)
        row = self._workspace.links[self.body_index(body)]
        return row[ka.R : ka.R + 9].reshape(3, 3).copy(), row[ka.P : ka.P + 3].copy()

    def joint_positions(self, q: ArrayLike, *further: tuple[str | int, ArrayLike]) -> Array:
        """World origins of all bodies, then the hand, (n + 1, 3) [m]: what a posture is drawn from.

        ``further`` : more points on bodies, after the hand
        """
        self._sweep(q)
        attached = [self._attached(body, point) for body, point in (self.robot.hand, *further)]
        on_bodies = np.zeros((len(attached), 3))
        for row, (index, on_body) in zip(on_bodies, attached, strict=True):
            joints.point_position(self._workspace, index, on_body, row)
        return np.vstack([self._workspace.links[:, ka.P : ka.P + 3], on_bodies])

    def kinetic_energy(self, q: ArrayLike, v: ArrayLike) -> float:
        """½ vᵀ M v [J]; rotors not included."""
        self._sweep(q, v)
        return float(ledger.kinetic_energy(self._bodies, self._workspace))

    def potential_energy(self, q: ArrayLike) -> float:
        """−Σ m g·c [J], zero with all masses at the world origin."""
        self._sweep(q)
        return float(ledger.potential_energy(self.arrays, self._workspace))

    def body_index(self, body: str | int) -> int:
        """Index of a body by name; an index stays as it is.

        Raises
        ------
        ModelError
            No such body.
        """
        if type(body) is int or isinstance(body, np.integer):
            # The kernels do not look whether an index is within their tables.
            if not 0 <= body < self.n:
                raise ModelError(f"no body {body}; indices of this model are 0 to {self.n - 1}")
            return int(body)
        for i, link in enumerate(self.robot.links):
            if link.name == body:
                return i
        raise ModelError(f"no body {body!r}; bodies: {', '.join(link.name for link in self.robot.links)}")

    def _attached(self, body: str | int, point: ArrayLike) -> tuple[int, Array]:
        """Index of the body that carries a body or frame, and the point in its frame [m]."""
        checked = self._point(point)
        return self.robot.attach(body, checked) if isinstance(body, str) else (self.body_index(body), checked)

    def _sweep(self, q: ArrayLike, v: ArrayLike | None = None) -> None:
        self._set(q, v)
        sweep.kinematics(self.arrays, self._workspace)

    def _set(self, q: ArrayLike, v: ArrayLike | None = None) -> None:
        positions = self._vector(q, "q", self._position_names)
        if self.nq == self.n:
            # A coordinate for each rate: most robots need not load the kernel that tells kinds of joints apart.
            self._workspace.joints[:, ka.Q] = positions
        else:
            self._q[:] = positions
            joints.read_positions(self.arrays, self._q, 0, self._workspace)
        self._workspace.joints[:, ka.QD] = 0.0 if v is None else self._vector(v, "v", self.joint_names)

    def _vector(self, values: ArrayLike, name: str, labels: tuple[str, ...]) -> Array:
        array = _numbers(values, name)
        if array.shape != (len(labels),):
            names = "joints" if self.nq == self.n else "coordinates" if name == "q" else "rates"
            raise ModelError(f"{name} has shape {array.shape}; this model has {len(labels)} {names}")
        # The sum of Python's numbers first: it neither warns nor takes as long as a look by numpy at every element.
        if not math.isfinite(sum(array.tolist())) and not np.isfinite(array).all():
            k = int(np.flatnonzero(~np.isfinite(array))[0])
            raise ModelError(f"{name} is {array[k]} at {labels[k]}; it must be finite")
        return array

    @staticmethod
    def _point(point: ArrayLike) -> Array:
        # A copy: an array of another layout would be compiled for anew.
        array = np.array(_numbers(point, "point"))
        if array.shape != (3,):
            raise ModelError(f"point has shape {array.shape}; it must be (3,): x, y, z in the body's frame [m]")
        if not math.isfinite(sum(array.tolist())) and not np.isfinite(array).all():
            raise ModelError(f"point is {array.tolist()}; it must be finite [m]")
        return array


def _numbers(values: ArrayLike, name: str) -> Array:
    """Real numbers as float64; texts, complex numbers and rows of unequal length are none."""
    if type(values) is np.ndarray and values.dtype is _FLOAT64:
        return values
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise ModelError(f"{name} is no array of numbers: {error}") from error
    if array.dtype.kind not in "fiu":
        raise ModelError(f"{name} must be real numbers, not {brief(values)}")
    return np.asarray(array, dtype=np.float64)
