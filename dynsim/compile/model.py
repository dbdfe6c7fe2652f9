"""Rigid-body model for use in Python, with one method per quantity and numpy arrays."""

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
from dynsim.compile.tables import compile_model, dry_frictions
from dynsim.config.problems import listed
from dynsim.dynamics import ledger
from dynsim.dynamics import tables as ka
from dynsim.dynamics.tree import articulated, joints, sweep
from dynsim.errors import ModelError, brief
from dynsim.model.description import Array, Contact, Robot
from dynsim.model.drives import Servo
from dynsim.model.surfaces import SolidPair, Surface
from dynsim.record import record
from dynsim.system.arguments import names_wrong_types

_FLOAT64 = np.dtype(np.float64)


@names_wrong_types
class Model:
    """Dynamics of a :class:`~dynsim.model.description.Robot`.

    Parameters
    ----------
    robot : Robot
        Tree of bodies with joints, motors and hand; :func:`dynsim.build_model` and :meth:`from_urdf` create models.

    Attributes
    ----------
    robot : Robot
        The description, with motors mounted.
    n : int
        Number of joint rates.
    nq : int
        Number of joint coordinates.

    Raises
    ------
    ModelError
        If the description is not a physically valid tree of bodies. Every method raises it for vectors of the wrong
        length, values that are not finite numbers, and unknown bodies.

    Notes
    -----
    ``M(q) v̇ + h(q, v) + g(q) = tau`` ([WM] eqs 42–44, 54–55): ``mass_matrix`` is M, ``bias_forces`` h + g. Rotor
    inertia, gear and joint losses and contacts are not included (they are set in motors and scenario); see ``armature``
    and ``damping``. The wheels of a mobile base are included except for their spin, which is in ``armature`` like the
    inertia of a rotor. Motor masses are included: they are attached to the links (:meth:`Robot.with_motors_mounted`).

    Examples
    --------
    >>> import dynsim
    >>> model = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
    >>> model
    <Model serial_arm: joint joint_1, no motors, hand on link_1, 1 kg>
    >>> model.mass_matrix([0.0]).round(4).tolist()
    [[0.3334]]
    """

    def __init__(self, robot: Robot) -> None:
        if not isinstance(robot, Robot):
            raise ModelError(
                f"robot must be a Robot, got {brief(robot)}; use Model.from_urdf(file) or build_model(scenario)"
            )
        robot = robot.with_motors_mounted() if any(motor.mass for motor in robot.motors) else robot
        self.robot = robot
        self.arrays = compile_model(robot)
        self.n, self.nq = len(robot.links), robot.nq
        self._workspace = ka.workspace(self.n, 0, 0)
        self._q = np.zeros(self.nq)
        self._braces: PreparedBraces | None = None  # braces in the last call of brace_statics
        self._position_names = robot.position_names  # cached, because it is computed from every link's kind
        # Tables without rotor inertia, used by forward_dynamics and mass_matrix.
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
        """Read bodies and joints from a URDF file; fixed joints are merged into their parents.

        Parameters
        ----------
        path : str or path-like
            URDF file.
        lock : mapping of str to float, optional
            Positions of joints to lock [rad or m].

        Returns
        -------
        Model
            Model without motors.

        Raises
        ------
        ModelError
            If the file is invalid. The message contains the file, the line, the link or joint, and a fix; see
            :func:`dynsim.model.urdf.reader.read_urdf`.

        Examples
        --------
        >>> import dynsim
        >>> from dynsim.system.shipped import SHIPPED
        >>> model = dynsim.Model.from_urdf(SHIPPED / "robots" / "six_axis_arm.urdf")
        >>> model.n
        6
        """
        from dynsim.model.urdf.reader import read_urdf

        if not isinstance(path, (str, os.PathLike)):
            raise ModelError(f"expected the path of a URDF file, got {brief(path)}")
        return cls(read_urdf(Path(path), lock))

    def to_urdf(self) -> str:
        """Return the tree of bodies as URDF text, with masses, limits, viscous losses, and visual and collision shapes.

        Returns
        -------
        str
            URDF document.

        Raises
        ------
        ModelError
            If URDF does not support a joint.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
        >>> "<robot" in model.to_urdf()
        True
        """
        from dynsim.compile.scene import with_shapes
        from dynsim.compile.solids import with_solids
        from dynsim.model.urdf.writer import write_urdf

        return write_urdf(with_solids(with_shapes(self.robot)))

    def to_mjcf(
        self,
        contacts: Sequence[Contact] = (),
        surfaces: Mapping[str, Surface] | None = None,
        *,
        gains: Mapping[str, tuple[float, float]] | None = None,
        meshes: Mapping[str, str] | None = None,
        touching: bool = False,
        pairs: Sequence[SolidPair] = (),
    ) -> str:
        """Return the tree of bodies as MJCF text (MuJoCo's format), with motors, their loops, and losses.

        Parameters
        ----------
        contacts : sequence of Contact, optional
            Contact points to export as sites.
        surfaces : mapping of str to Surface, optional
            Planes, spheres, cylinders and boxes to export as shapes; other surfaces are omitted.
        gains : mapping of str to (float, float), optional
            Gains k_p and k_d of the voltage controllers of DC motors, by joint [V/rad, V s/rad; V/m, V s/m]; the
            control of an actuator is then a reference of its joint. Default: no controllers; the control is a voltage.
        meshes : mapping of str to str, optional
            Paths of mesh files that MuJoCo can read, by the name of the mesh in the shapes; default: no meshes.
        touching : bool, optional
            If True, contact points collide with their surfaces, and pairs of solids with each other; otherwise nothing
            collides.
        pairs : sequence of SolidPair, optional
            Pairs of solids that collide if ``touching`` is True.

        Returns
        -------
        str
            MJCF document.

        Raises
        ------
        ModelError
            If MJCF does not support a joint, such as wheels that roll without slip.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
        >>> "<mujoco" in model.to_mjcf()
        True
        """
        from dynsim.compile.scene import drawn_surface, with_shapes
        from dynsim.model.mjcf import back_emf_damping, write_mjcf

        known = surfaces or {}
        drawn = [(drawn_surface(name, surface), surface.carrier) for name, surface in known.items()]
        own = [contact for contact in contacts if not contact.is_between_bodies]
        rubs = {rubbing.joint: rubbing.gear + rubbing.bearing for rubbing in dry_frictions(self.robot)}
        damping = self.damping.copy()
        for motor in self.robot.motors:
            damping[self.joint_names.index(motor.joint)] += back_emf_damping(motor)
            if isinstance(motor, Servo) and motor.coulomb_speed is not None:  # smoothed friction becomes dry
                rubs[motor.joint] = rubs.get(motor.joint, 0.0) + motor.coulomb_friction
        described = with_shapes(self.robot, "capsule")
        return write_mjcf(
            described, own, drawn, damping, self.armature, rubs, gains or {}, meshes or {}, touching, pairs
        )

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in the order of v."""
        return self.robot.joint_names

    @property
    def geometry(self) -> ka.ModelArrays:
        """Tables without masses, inertias and losses; together with q, they determine the poses of the bodies."""
        body = self.arrays.body.copy()
        body[:, ka.MASS : ka.PARAMETER] = 0.0
        return self.arrays._replace(body=body, gravity=np.zeros(3))

    @property
    def armature(self) -> Array:
        """Inertia that only spins with each joint: reflected rotor inertia J_m or wheel spin inertia [kg m²], (n,)."""
        return self.arrays.body[:, ka.ARMATURE].copy()

    @property
    def damping(self) -> Array:
        """Viscous losses of each joint, D + D_m [N m s/rad], (n,)."""
        return self.arrays.body[:, ka.DAMPING] + self.arrays.body[:, ka.GEAR_DAMPING]

    @property
    def coupling_rows(self) -> Array:
        """Rows C of the joint couplings, C v = 0, (k, n)."""
        rows = np.zeros((len(self.robot.couplings), self.n))
        for row, coupling in zip(rows, self.robot.couplings, strict=True):
            row[self.joint_names.index(coupling.joint)] = 1.0
            row[self.joint_names.index(coupling.leader)] = -coupling.ratio
        return rows

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Compute the mass matrix M(q).

        Parameters
        ----------
        q : array_like, shape (nq,)
            Joint positions [rad or m].

        Returns
        -------
        (n, n) ndarray
            Mass matrix [kg m²; kg m, kg at prismatic joints], without rotors.

        Raises
        ------
        ModelError
            If the shape is wrong, or a value is not finite.

        Notes
        -----
        [WM] eq 55.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("elbow_comparison"))
        >>> model.mass_matrix(model.robot.initial).shape
        (10, 10)
        """
        self._set(q)
        M = np.zeros((self.n, self.n))
        sweep.mass_matrix(self.arrays, self._workspace, M)
        return M

    def bias_forces(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Compute the velocity and gravity forces h(q, v) + g(q).

        Parameters
        ----------
        q : array_like, shape (nq,)
            Joint positions [rad or m].
        v : array_like, shape (n,)
            Joint rates [rad/s or m/s].

        Returns
        -------
        (n,) ndarray
            Joint torques or forces [N m or N].

        Raises
        ------
        ModelError
            If a shape is wrong, or a value is not finite.

        Notes
        -----
        [WM] eq 54.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
        >>> model.bias_forces([1.5707963], [0.0]).round(3).tolist()
        [-4.905]
        """
        self._set(q, v)
        sweep.newton_euler(self.arrays, self._workspace, 1.0, 0.0, 1.0)
        return self._workspace.joints[:, ka.BIAS].copy()

    def inverse_dynamics(self, q: ArrayLike, v: ArrayLike, vdot: ArrayLike) -> Array:
        """Compute the joint torques for an acceleration, tau = M v̇ + h + g.

        Parameters
        ----------
        q : array_like, shape (nq,)
            Joint positions [rad or m].
        v : array_like, shape (n,)
            Joint rates [rad/s or m/s].
        vdot : array_like, shape (n,)
            Joint accelerations [rad/s² or m/s²].

        Returns
        -------
        (n,) ndarray
            Joint torques or forces [N m or N].

        Raises
        ------
        ModelError
            If a shape is wrong, or a value is not finite.

        Notes
        -----
        [WM] eqs 42–44.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
        >>> model.inverse_dynamics([0.0], [0.0], [1.0]).round(4).tolist()
        [0.3334]
        """
        self._set(q, v)
        self._workspace.joints[:, ka.QDD] = self._vector(vdot, "vdot", self.joint_names)
        sweep.newton_euler(self.arrays, self._workspace, 1.0, 1.0, 1.0)
        return self._workspace.joints[:, ka.BIAS].copy()

    def forward_dynamics(self, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> Array:
        """Compute the joint accelerations for torques, v̇ = M⁻¹ (tau − h − g).

        Parameters
        ----------
        q : array_like, shape (nq,)
            Joint positions [rad or m].
        v : array_like, shape (n,)
            Joint rates [rad/s or m/s].
        tau : array_like, shape (n,)
            Joint torques or forces [N m or N].

        Returns
        -------
        (n,) ndarray
            Joint accelerations [rad/s² or m/s²].

        Raises
        ------
        ModelError
            If a shape is wrong, or a value is not finite.

        Notes
        -----
        The method is the articulated-body algorithm; rotor inertia is not included.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
        >>> model.forward_dynamics([0.5], [0.0], [0.0]).round(3).tolist()
        [7.054]
        """
        self._set(q, v)
        self._workspace.joints[:, ka.APPLIED] = self._vector(tau, "tau", self.joint_names)
        articulated.forward_dynamics(self._bodies, self._workspace)
        return self._workspace.joints[:, ka.QDD].copy()

    def articulated_inertia(self, q: ArrayLike) -> Array:
        """Compute the inertia, including rotors, that each joint moves if all joints beyond it are free.

        Parameters
        ----------
        q : array_like, shape (nq,)
            Joint positions [rad or m].

        Returns
        -------
        (n,) ndarray
            Articulated inertias [kg m²; kg at prismatic joints].

        Raises
        ------
        ModelError
            If the shape is wrong, or a value is not finite.

        Notes
        -----
        These are the pivots of the mass matrix, computed by the articulated-body sweep. For a joint that moves no
        inertia, the pivot is zero up to rounding, and the pivots of the joints before it are undefined.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
        >>> model.articulated_inertia([0.0]).round(4).tolist()
        [0.3334]
        """
        self._set(q)
        self._workspace.joints[:, ka.APPLIED] = 0.0
        articulated.forward_dynamics(self.arrays, self._workspace)
        with np.errstate(divide="ignore"):
            return 1.0 / self._workspace.links[:, ka.INVERSE_D]

    def derivatives(self, q: ArrayLike, v: ArrayLike, vdot: ArrayLike) -> InverseDynamicsDerivatives:
        """Compute the derivatives of inverse dynamics, ∂tau/∂q, ∂tau/∂v and ∂tau/∂v̇ = M, in closed form.

        Parameters
        ----------
        q : array_like, shape (nq,)
            Joint positions [rad or m].
        v : array_like, shape (n,)
            Joint rates [rad/s or m/s].
        vdot : array_like, shape (n,)
            Joint accelerations [rad/s² or m/s²].

        Returns
        -------
        InverseDynamicsDerivatives
            Matrices ``q``, ``v`` and ``vdot``, (n, n) each.

        Raises
        ------
        ModelError
            If a shape is wrong, or a value is not finite.

        Notes
        -----
        Method of Singh, Russo and Wensing (2022). The derivatives of forward dynamics follow from them at
        v̇ = M⁻¹ (tau − h − g): ∂v̇/∂q = −M⁻¹ ∂tau/∂q, ∂v̇/∂v = −M⁻¹ ∂tau/∂v. Rotor inertia, losses and contacts are not
        included;
        :meth:`dynsim.Simulation.linearize` includes them all.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
        >>> model.derivatives([0.0], [0.0], [0.0]).q.round(3).tolist()
        [[-4.905]]
        """
        self.inverse_dynamics(q, v, vdot)
        return inverse_dynamics_derivatives(self.arrays, self._workspace.links)

    def brace_statics(self, q: ArrayLike, v: ArrayLike, vdot: ArrayLike, braces: Mapping[str, Brace]) -> BraceStatics:
        """Compute the torques and brace forces that minimize motor heat for an acceleration, or prove that none exist.

        Parameters
        ----------
        q : array_like, shape (nq,)
            Joint positions [rad or m].
        v : array_like, shape (n,)
            Joint rates [rad/s or m/s].
        vdot : array_like, shape (n,)
            Joint accelerations [rad/s² or m/s²].
        braces : mapping of str to Brace
            Named braces.

        Returns
        -------
        BraceStatics
            Torques, heat, brace forces and their possible intervals, or a certificate of infeasibility.

        Raises
        ------
        ModelError
            If a brace is on an unknown body, or the robot has coupled joints.

        Notes
        -----
        tau = M v̇ + h + g + J_m v̇ + (D + D_m) v − J_cᵀ f,   minimize Σ R i², K_m i = tau

        subject to |f_t| ≤ μ f_n, f_n ≥ min_N (or f_n as commanded, or f_t opposing the slip), the motor limits at a
        steady current, and tau = 0 for joints without motors. The optimum uses friction up to the limit of the cone;
        the friction force of a real brace depends on its history. The torques are unique. Brace forces that do not
        affect any motor are not unique; the result is one possible split inside the cones.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("elbow_comparison"))
        >>> braces = {"elbow_7": dynsim.Brace("link_7", [0, 0, 0], normal=[0, 0, 1], friction=0.1)}
        >>> statics = model.brace_statics(model.robot.initial, [0] * 10, [0] * 10, braces)
        >>> statics.feasible, round(statics.heat, 2), round(statics.normal_forces["elbow_7"], 2)
        (True, 19.17, 8.03)
        """
        names = self.joint_names
        positions, rates = self._vector(q, "q", self._position_names), self._vector(v, "v", names)
        accelerations = self._vector(vdot, "vdot", names)
        if self._braces is None or not self._braces.match(braces):
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
        """Find a posture near `q` that puts the hand at `target` within the joint limits.

        Parameters
        ----------
        target : array_like, shape (3,)
            Hand position in the world frame [m].
        q : array_like, shape (nq,), optional
            Start of the search, which selects the solution branch [rad or m]; default: the initial posture.
        orientation : array_like, shape (3, 3), optional
            Rotation of the hand's body or frame in the world; default: any.
        braces : sequence of Contact, optional
            Points to keep on their surfaces, see :func:`dynsim.scenario.build.contacts`.
        tolerance : float, optional
            Maximum residual of the position and the gaps [m] and of the angles [rad].

        Returns
        -------
        (nq,) ndarray
            Joint positions [rad or m].

        Raises
        ------
        UnreachableReference
            If no posture is found; the message contains the residual and the joints at their limits.
        ModelError
            If the robot has coupled joints or joints with several coordinates, or `orientation` is not a rotation.

        Notes
        -----
        The search takes damped Gauss–Newton steps of minimum norm, dq = Jᵀ (J Jᵀ + λ 1)⁻¹ e, with λ decreasing with the
        error. Joints at their limits stay there, and the other joints take over.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("elbow_comparison"))
        >>> q = model.inverse_kinematics([1.5, 1.5, 0.4])
        >>> model.point_position(*model.robot.hand, q).round(6).tolist()
        [1.5, 1.5, 0.4]
        """
        wanted = None
        if orientation is not None:
            wanted = np.array(_numbers(orientation, "orientation"))
            if wanted.shape != (3, 3) or not np.abs(wanted @ wanted.T - np.eye(3)).max() < 1e-6:
                raise ModelError("orientation must be a rotation, (3, 3)")
        start = self.robot.initial if q is None else self._vector(q, "q", self._position_names)
        return hand_posture(self, self._point(target), np.array(start), wanted, braces, tolerance)

    def point_position(self, body: str | int, point: ArrayLike, q: ArrayLike) -> Array:
        """Compute the world position of a point fixed on a body or frame.

        Parameters
        ----------
        body : str or int
            Name of a body or frame, or index of a body.
        point : array_like, shape (3,)
            Point in the frame of the body [m].
        q : array_like, shape (nq,)
            Joint positions [rad or m].

        Returns
        -------
        (3,) ndarray
            Position in the world frame [m].

        Raises
        ------
        ModelError
            If the body does not exist, a shape is wrong, or a value is not finite.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
        >>> model.point_position("link_1", [0, 0, 1], [0.0]).tolist()
        [0.0, 0.0, 1.0]
        """
        index, on_body = self._attached(body, point)
        self._sweep(q)
        out = np.zeros(3)
        joints.point_position(self._workspace, index, on_body, out)
        return out

    def point_jacobian(self, body: str | int, point: ArrayLike, q: ArrayLike) -> Array:
        """Compute the Jacobian J of a body-fixed point: its velocity in the world frame is J v.

        Parameters
        ----------
        body : str or int
            Name of a body or frame, or index of a body.
        point : array_like, shape (3,)
            Point in the frame of the body [m].
        q : array_like, shape (nq,)
            Joint positions [rad or m].

        Returns
        -------
        (3, n) ndarray
            Jacobian [m/rad or 1].

        Raises
        ------
        ModelError
            If the body does not exist, a shape is wrong, or a value is not finite.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
        >>> model.point_jacobian("link_1", [0, 0, 1], [0.0]).tolist()
        [[1.0], [0.0], [0.0]]
        """
        return self.point_position_and_jacobian(body, point, q)[1]

    def point_position_and_jacobian(self, body: str | int, point: ArrayLike, q: ArrayLike) -> tuple[Array, Array]:
        """Compute the world position and the Jacobian of a body-fixed point in a single sweep.

        Parameters
        ----------
        body : str or int
            Name of a body or frame, or index of a body.
        point : array_like, shape (3,)
            Point in the frame of the body [m].
        q : array_like, shape (nq,)
            Joint positions [rad or m].

        Returns
        -------
        position : (3,) ndarray
            Position in the world frame [m].
        jacobian : (3, n) ndarray
            Jacobian [m/rad or 1].

        Raises
        ------
        ModelError
            If the body does not exist, a shape is wrong, or a value is not finite.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("elbow_comparison"))
        >>> position, jacobian = model.point_position_and_jacobian(*model.robot.hand, model.robot.initial)
        >>> position.round(3).tolist(), jacobian.shape
        ([1.536, 1.536, 0.424], (3, 10))
        """
        index, on_body = self._attached(body, point)
        position = self.point_position(index, on_body, q)
        jacobian = np.zeros((3, self.n))
        joints.point_jacobian(self.arrays, self._workspace, index, position, jacobian)
        return position, jacobian

    def body_pose(self, body: str | int, q: ArrayLike) -> tuple[Array, Array]:
        """Compute the rotation and the origin of a body.

        Parameters
        ----------
        body : str or int
            Name or index of a body.
        q : array_like, shape (nq,)
            Joint positions [rad or m].

        Returns
        -------
        rotation : (3, 3) ndarray
            Rotation R_WB from the body frame to the world frame.
        origin : (3,) ndarray
            Origin p_WB in the world frame [m].

        Raises
        ------
        ModelError
            If the body does not exist, a shape is wrong, or a value is not finite.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
        >>> rotation, origin = model.body_pose("link_1", [0.0])
        >>> rotation.shape, origin.tolist()
        ((3, 3), [0.0, 0.0, 0.0])
        """
        self._sweep(q)
        row = self._workspace.links[self.body_index(body)]
        return row[ka.R : ka.R + 9].reshape(3, 3).copy(), row[ka.P : ka.P + 3].copy()

    def joint_positions(self, q: ArrayLike, *further: tuple[str | int, ArrayLike]) -> Array:
        """Compute the world positions of all body origins, followed by the hand, e.g. to draw a posture.

        Parameters
        ----------
        q : array_like, shape (nq,)
            Joint positions [rad or m].
        *further : (str or int, array_like of shape (3,))
            Body and point [m] of additional points, after the hand.

        Returns
        -------
        (n + 1 + len(further), 3) ndarray
            Positions in the world frame [m].

        Raises
        ------
        ModelError
            If a body does not exist, a shape is wrong, or a value is not finite.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
        >>> model.joint_positions([0.0]).tolist()
        [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
        """
        self._sweep(q)
        attached = [self._attached(body, point) for body, point in (self.robot.hand, *further)]
        on_bodies = np.zeros((len(attached), 3))
        for row, (index, on_body) in zip(on_bodies, attached, strict=True):
            joints.point_position(self._workspace, index, on_body, row)
        return np.vstack([self._workspace.links[:, ka.P : ka.P + 3], on_bodies])

    def kinetic_energy(self, q: ArrayLike, v: ArrayLike) -> float:
        """Compute the kinetic energy ½ vᵀ M v, without rotors.

        Parameters
        ----------
        q : array_like, shape (nq,)
            Joint positions [rad or m].
        v : array_like, shape (n,)
            Joint rates [rad/s or m/s].

        Returns
        -------
        float
            Kinetic energy [J].

        Raises
        ------
        ModelError
            If a shape is wrong, or a value is not finite.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
        >>> round(model.kinetic_energy([0.0], [1.0]), 4)
        0.1667
        """
        self._sweep(q, v)
        return float(ledger.kinetic_energy(self._bodies, self._workspace))

    def potential_energy(self, q: ArrayLike) -> float:
        """Compute the potential energy −Σ m g·c, which is zero if all masses are at the world origin.

        Parameters
        ----------
        q : array_like, shape (nq,)
            Joint positions [rad or m].

        Returns
        -------
        float
            Potential energy [J].

        Raises
        ------
        ModelError
            If the shape is wrong, or a value is not finite.

        Examples
        --------
        >>> import dynsim
        >>> model = dynsim.build_model(dynsim.load_scenario("single_pendulum"))
        >>> round(model.potential_energy([0.0]), 3)
        4.905
        """
        self._sweep(q)
        return float(ledger.potential_energy(self.arrays, self._workspace))

    def body_index(self, body: str | int) -> int:
        """Return the index of a body given its name or index.

        Parameters
        ----------
        body : str or int
            Name or index of a body.

        Returns
        -------
        int
            Index of the body.

        Raises
        ------
        ModelError
            If the body does not exist.

        Examples
        --------
        >>> import dynsim
        >>> dynsim.build_model(dynsim.load_scenario("elbow_comparison")).body_index("link_7")
        6
        """
        if type(body) is int or isinstance(body, np.integer):
            # The kernels do not check whether an index is within their tables.
            if not 0 <= body < self.n:
                raise ModelError(f"no body {body}; indices of this model are 0 to {self.n - 1}")
            return int(body)
        for i, link in enumerate(self.robot.links):
            if link.name == body:
                return i
        raise ModelError(f"no body {body!r}; bodies: {', '.join(link.name for link in self.robot.links)}")

    def _attached(self, body: str | int, point: ArrayLike) -> tuple[int, Array]:
        """Return the index of the body that carries a body or frame, and the point in its frame [m]."""
        checked = self._point(point)
        return self.robot.attach(body, checked) if isinstance(body, str) else (self.body_index(body), checked)

    def _sweep(self, q: ArrayLike, v: ArrayLike | None = None) -> None:
        self._set(q, v)
        sweep.kinematics(self.arrays, self._workspace)

    def _set(self, q: ArrayLike, v: ArrayLike | None = None) -> None:
        positions = self._vector(q, "q", self._position_names)
        if self.nq == self.n:
            # With one coordinate per rate, as for most robots, the kernel that distinguishes joint kinds is not needed.
            self._workspace.joints[:, ka.Q] = positions
        else:
            self._q[:] = positions
            joints.read_positions(self.arrays, self._q, 0, self._workspace)
        self._workspace.joints[:, ka.QD] = 0.0 if v is None else self._vector(v, "v", self.joint_names)

    def _vector(self, values: ArrayLike, name: str, labels: tuple[str, ...]) -> Array:
        array = _numbers(values, name)
        if array.shape != (len(labels),):
            names = "joints" if self.nq == self.n else "coordinates" if name == "q" else "rates"
            raise ModelError(f"{name} must have {len(labels)} values ({names} of this model), got shape {array.shape}")
        # Sum Python numbers first: unlike a numpy check of every element, this is fast and emits no warning.
        if not math.isfinite(sum(array.tolist())) and not np.isfinite(array).all():
            k = int(np.flatnonzero(~np.isfinite(array))[0])
            raise ModelError(f"{name} must be finite, got {array[k]} at {labels[k]}")
        return array

    @staticmethod
    def _point(point: ArrayLike) -> Array:
        # Copy the array, because kernels would be compiled again for another memory layout.
        array = np.array(_numbers(point, "point"))
        if array.shape != (3,):
            raise ModelError(f"point must have shape (3,): x, y, z in the body's frame [m], got {array.shape}")
        if not math.isfinite(sum(array.tolist())) and not np.isfinite(array).all():
            raise ModelError(f"point must be finite [m], got {array.tolist()}")
        return array


def _numbers(values: ArrayLike, name: str) -> Array:
    """Return real numbers as float64; raise ModelError for strings, complex numbers and rows of unequal length."""
    if type(values) is np.ndarray and values.dtype is _FLOAT64:
        return values
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise ModelError(f"{name} must be an array of numbers: {error}") from error
    if array.dtype.kind not in "fiu":
        raise ModelError(f"{name} must be real numbers, got {brief(values)}")
    return np.asarray(array, dtype=np.float64)
