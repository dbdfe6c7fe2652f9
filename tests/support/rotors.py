"""Study: rotors as armature at their joints, compared with rotors as separate bodies.

dynsim gives a rotor the inertia J_m = I_m k² at its joint ([WM] eq 25), as if its axis did not turn. In fact the link
before the joint carries it: with the angular velocity ω of that link and the axis a of the joint, the rotor has the
speed k v + a·ω about its axis and the energy ½ I_m (k v + a·ω)². This study computes that without dynsim's right-hand
side: rotors are bodies of a larger tree, tied to their joints by θ = k q (θ: angle of the rotor on that link), and the
dense equations are integrated by the classical Runge–Kutta method.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from dynsim.compile.control import JointControl
from dynsim.compile.model import Model
from dynsim.errors import ModelError
from dynsim.model.description import Array, Contact, Inertia, Link, Quadric
from dynsim.model.drives import Motor
from dynsim.scenario import Scenario, build, build_model

# Step, and the shorter step of the first START_S, while the motors build up torque against the weight [s].
STEP, START_STEP, START_S = 5e-4, 1.25e-4, 0.5


class RotorModel:
    """Dense dynamics of a revolute robot, its motors and bilateral contacts.

    Parameters
    ----------
    spinning : bool
        Every rotor is a thin disc on the link before its joint; otherwise J_m = I_m k² on the diagonal, as in dynsim.
    """

    def __init__(
        self, model: Model, contacts: list[Contact], control: JointControl, duration: float, *, spinning: bool
    ) -> None:
        robot = model.robot
        n = model.n
        self.model, self.contacts, self.control, self.duration = model, contacts, control, duration
        self.joint = np.array([model.joint_names.index(motor.joint) for motor in robot.motors])
        motors = [motor for motor in robot.motors if isinstance(motor, Motor)]
        if len(motors) < len(robot.motors):
            raise ModelError(f"{robot.name}: only DC motors have rotors here")
        of = [(motor.gear_ratio, motor) for motor in motors]
        self.torque_constant = np.array([motor.joint_constant for motor in motors])
        self.resistance = np.array([motor.resistance for _, motor in of])
        self.inductance = np.array([motor.inductance for _, motor in of])
        self.loss = np.array([link.damping for link in robot.links])
        np.add.at(self.loss, self.joint, [k**2 * motor.gear_damping for k, motor in of])
        ratio = np.array([k for k, _ in of])
        if spinning:
            rotors = tuple(
                _rotor(robot.links[j], motor.rotor_inertia) for j, (_, motor) in zip(self.joint, of, strict=True)
            )
            turns = np.append(robot.initial, np.zeros(len(rotors)))
            self.tree = Model(dataclasses.replace(robot, links=robot.links + rotors, motors=(), q0=turns))
            self.gears = np.vstack([np.eye(n), ratio[:, None] * np.eye(n)[self.joint]])
            self.armature = np.zeros(n)
        else:
            self.tree = Model(dataclasses.replace(robot, motors=()))
            self.gears = np.eye(n)
            self.armature = np.zeros(n)
            np.add.at(self.armature, self.joint, [k**2 * motor.rotor_inertia for k, motor in of])

    def mass_matrix(self, q: Array) -> Array:
        """Return M of bodies and rotors in the joint coordinates, (n, n)."""
        return self.gears.T @ self.tree.mass_matrix(self.gears @ q) @ self.gears + np.diag(self.armature)

    def voltage(self, t: float, q: Array, v: Array) -> Array:
        """Return the voltages of [WM] eq 56, (na,) [V]."""
        control, reference = self.control, self.control.reference
        begin, spacing = reference.grid
        segment = int(np.clip((t - begin) // spacing, 0, len(reference.coefficients) - 1))
        x = t - begin - segment * spacing
        powers = x ** np.arange(6)
        slopes = np.array([0.0, *(k * x ** (k - 1) for k in range(1, 6))])
        moving = reference.spline >= 0
        wanted, rate = reference.held.copy(), np.zeros(len(reference.held))
        coefficients = reference.coefficients[segment, reference.spline[moving]]
        wanted[moving], rate[moving] = coefficients @ powers, coefficients @ slopes
        return np.asarray(control.k_p * (wanted - q[self.joint]) + control.k_d * (rate - v[self.joint]))

    def derivative(self, t: float, y: Array) -> Array:
        """Return dy/dt of y = (q, v, i, ∫ Σ u i dt) by one dense solve, as [WM] eq 35."""
        n, p = self.model.n, len(self.contacts)
        q, v, current = y[:n], y[n : 2 * n], y[2 * n : -1]
        u = self.voltage(t, q, v)
        bias = self.gears.T @ self.tree.bias_forces(self.gears @ q, self.gears @ v)
        matrix, right = np.zeros((n + p, n + p)), np.zeros(n + p)
        matrix[:n, :n] = self.mass_matrix(q)
        right[:n] = -bias - self.loss * v
        np.add.at(right, self.joint, self.torque_constant * current)
        for k, contact in enumerate(self.contacts):
            J, drift = self._point(contact, q, v)
            position = self.model.point_position(contact.body, contact.point, q)
            assert isinstance(contact.surface, Quadric)
            gradient = contact.surface.Q @ position + contact.surface.b
            slope = np.linalg.norm(gradient)
            normal, rdot = gradient / slope, J @ v
            slip = rdot - (normal @ rdot) * normal
            tangent = slip / np.sqrt(slip @ slip + contact.slip_smoothing**2)
            matrix[n + k, :n] = normal @ J
            matrix[:n, n + k] = -(normal - contact.friction * tangent) @ J
            right[n + k] = -normal @ drift - rdot @ contact.surface.Q @ rdot / slope
        vdot = np.linalg.solve(matrix, right)[:n]
        rise = (u - self.resistance * current - self.torque_constant * v[self.joint]) / self.inductance
        return np.concatenate([v, vdot, rise, [u @ current]])

    def _point(self, contact: Contact, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the Jacobian of a contact point, and J̇ v by a central difference along v."""
        step = 1e-6 / max(1.0, float(np.abs(v).max()))
        J, ahead, behind = (
            self.model.point_jacobian(contact.body, contact.point, q + s * v) for s in (0.0, step, -step)
        )
        return J, (ahead - behind) @ v / (2.0 * step)

    def energy(self) -> float:
        """Return ∫ Σ u i dt over the run [J], by the classical Runge–Kutta method from rest."""
        y = np.concatenate([self.model.robot.initial, np.zeros(self.model.n + len(self.joint) + 1)])
        start = min(START_S, self.duration)
        t = 0.0
        for end, step in ((start, START_STEP), (self.duration, STEP)):
            count = round((end - t) / step)
            for _ in range(count):
                y = self._step(t, y, step)
                t += step
        return float(y[-1])

    def _step(self, t: float, y: Array, h: float) -> Array:
        a = self.derivative(t, y)
        b = self.derivative(t + 0.5 * h, y + 0.5 * h * a)
        c = self.derivative(t + 0.5 * h, y + 0.5 * h * b)
        return y + h / 6.0 * (a + 2.0 * b + 2.0 * c + self.derivative(t + h, y + h * c))


def _rotor(link: Link, inertia: float) -> Link:
    """Return a disc without mass on the link before a joint, about the joint's axis: I_m, and half of it across."""
    across = 0.5 * inertia * (np.eye(3) - np.outer(link.axis, link.axis))
    disc = Inertia(0.0, np.zeros(3), inertia * np.outer(link.axis, link.axis) + across)
    return Link(
        name=f"rotor of {link.joint}",
        joint=f"rotor of {link.joint}",
        parent=link.parent,
        kind="revolute",
        axis=link.axis,
        inertia=disc,
        R_PJ=link.R_PJ,
        p_PJ=link.p_PJ,
    )


def rotor_model(scenario: Scenario, *, spinning: bool) -> RotorModel:
    """Return the :class:`RotorModel` of a scenario with a joint controller, revolute joints and signed friction."""
    model = build_model(scenario)
    control = build.controller(scenario, model)
    return RotorModel(model, build.contacts(scenario), control, scenario.duration_s, spinning=spinning)


def rotor_energies(scenario: Scenario) -> dict[str, float]:
    """Return electrical energy [J] with rotors as armature and as spinning bodies, both integrated by this module."""
    return {
        name: rotor_model(scenario, spinning=spinning).energy()
        for name, spinning in (("armature", False), ("spinning", True))
    }
