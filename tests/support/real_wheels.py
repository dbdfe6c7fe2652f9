"""Independent model of a mobile arm in Pinocchio: planar base, two spinning wheels, rolling by multipliers.

The base slides along the world's x and y and turns about z; each wheel is a separate disc that turns on its axle; the
arm stands on the base. The axle does not slip sideways and no wheel slips along: rows A v = 0, whose forces are solved
for together with the accelerations. It does not use the coordinates, rows or merged inertias of dynsim's joint.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from dynsim.model.urdf.writer import write_urdf
from support.random_robots import random_inertia, random_robot, random_unit

Array = np.ndarray
WHEELS = ("base.left", "base.right")
MOTOR = {
    "type": "dc",
    "torque_constant_N_m_per_A": 0.203,
    "resistance_ohm": 1.1,
    "inductance_H": 0.0017,
    "rotor_inertia_kg_m2": 1.64e-4,
    "gear_ratio": 3.0,
    "gear_damping_N_m_s_per_rad": 0.01,
}


def six(tensor: Array) -> list[float]:
    """Return xx xy xz yy yz zz."""
    return [float(tensor[i, j]) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]


def symmetric(values: list[float]) -> Array:
    """Return the tensor of xx xy xz yy yz zz."""
    xx, xy, xz, yy, yz, zz = values
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def about_z(angle: float) -> Array:
    """Return the rotation matrix about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def random_motor(rng: np.random.Generator) -> dict[str, Any]:
    """Return the keys of a DC motor; half of them have a mass."""
    return {
        "mass_kg": float(rng.uniform(0.1, 0.8)) if rng.random() < 0.5 else 0.0,
        "type": "dc",
        "torque_constant_N_m_per_A": float(rng.uniform(0.05, 0.3)),
        "resistance_ohm": float(rng.uniform(0.5, 2.0)),
        "inductance_H": float(rng.uniform(1e-3, 5e-3)),
        "rotor_inertia_kg_m2": float(rng.uniform(1e-5, 3e-4)),
        "gear_ratio": float(rng.uniform(1.0, 10.0)),
        "gear_damping_N_m_s_per_rad": float(rng.uniform(0.0, 0.02)),
    }


def random_base(rng: np.random.Generator) -> dict[str, Any]:
    """Return a body of any centre of mass and inertia, wheels that are not ideal discs, and an arm in any attitude."""
    body = random_inertia(rng)
    mass = float(rng.uniform(0.05, 0.5))
    radius = float(rng.uniform(0.03, 0.12))
    return {
        "position_m": rng.normal(size=2).tolist(),
        "heading_deg": float(rng.uniform(-180, 180)),
        "mass_kg": 3.0 * body.mass,
        "com_m": body.com.tolist(),
        "inertia_kg_m2": six(3.0 * body.tensor),
        "wheel": {
            "mass_kg": mass,
            "radius_m": radius,
            "inertia_axle_kg_m2": mass * radius**2 * float(rng.uniform(0.3, 0.9)),
            "inertia_across_kg_m2": mass * radius**2 * float(rng.uniform(0.5, 0.6)),
            "damping_N_m_s_per_rad": float(rng.uniform(0.0, 0.1)),
            "motor": random_motor(rng) | {"mass_kg": 0.3, "mass_point_m": rng.normal(scale=0.1, size=3).tolist()},
        },
        "track_m": float(rng.uniform(0.15, 0.6)),
        "caster_m": [0.15, 0.0, 0.0],
        "mount": {"position_m": rng.normal(scale=0.2, size=3).tolist(), "yaw_deg": float(rng.uniform(-180, 180))},
    }


def random_serial(rng: np.random.Generator, n: int) -> dict[str, Any]:
    """Return a chain about any axes, with sliding joints, whose links have full inertia tensors."""
    chain = []
    for _ in range(n):
        inertia, slides = random_inertia(rng), rng.random() < 0.2
        loss = "damping_N_s_per_m" if slides else "damping_N_m_s_per_rad"
        entry: dict[str, Any] = {
            "kind": "prismatic" if slides else "revolute",
            "axis": random_unit(rng).tolist() if rng.random() < 0.5 else str(rng.choice(["x", "y", "z"])),
            "length_m": float(rng.uniform(0.0, 0.5)),
            "mass_kg": inertia.mass,
            "com_m": inertia.com.tolist(),
            "inertia_kg_m2": six(inertia.tensor),
            loss: float(rng.uniform(0.0, 0.5)),
        }
        chain.append(entry | ({"motor": random_motor(rng)} if rng.random() < 0.7 else {}))
    return {"type": "serial_arm", "gravity_m_s2": rng.normal(scale=6.0, size=3).tolist(), "chain": chain}


def random_urdf(rng: np.random.Generator, n: int, file: Path) -> dict[str, Any]:
    """Write a tree with branches as a URDF file, whose root has mass, and a bracket fixed to it with mass."""
    root = ElementTree.fromstring(write_urdf(random_robot(rng, n, motors=False)))
    first = next(link for link in root.iter("link") if link.find("inertial") is None)
    bracket = ElementTree.SubElement(root, "link", name="bracket")
    for link in (first, bracket):
        body, inertial = random_inertia(rng), ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=" ".join(map(repr, body.com.tolist())), rpy="0.1 -0.2 0.3")
        ElementTree.SubElement(inertial, "mass", value=repr(float(body.mass)))
        names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        ElementTree.SubElement(inertial, "inertia", dict(zip(names, map(repr, six(body.tensor)), strict=True)))
    fixed = ElementTree.SubElement(root, "joint", name="bracket_mount", type="fixed")
    ElementTree.SubElement(fixed, "origin", xyz="0.1 -0.05 0.2", rpy="0.4 0.5 -0.6")
    ElementTree.SubElement(fixed, "parent", link=first.attrib["name"])
    ElementTree.SubElement(fixed, "child", link="bracket")
    file.write_text(ElementTree.tostring(root, encoding="unicode"))
    return {
        "type": "urdf_arm",
        "file": str(file),
        "gravity_m_s2": rng.normal(scale=6.0, size=3).tolist(),
        "motors": {f"joint_{i}": random_motor(rng) for i in range(n) if rng.random() < 0.7},
    }


class RealWheels:
    """Plant of a scenario, given by its keys.

    Coordinates X, Y, heading in the world, angles of the left and the right wheel, joints of the arm. Rates likewise;
    forces of motors and losses are generalised forces on them, rotors an armature on the diagonal of M.

    Attributes
    ----------
    joints : list of str
        Names of dynsim's rates.
    """

    def __init__(self, plant: dict[str, Any]) -> None:
        base, arm = plant["base"], plant["arm"]
        wheel, self.base, self.model = base["wheel"], base, pin.Model()
        self.r, self.track = float(wheel["radius_m"]), float(base["track_m"])
        joint, here = 0, pin.SE3.Identity()
        for name, kind in (("X", pin.JointModelPX()), ("Y", pin.JointModelPY()), ("heading", pin.JointModelRZ())):
            joint = self.model.addJoint(joint, kind, here, name)
        self.body = joint
        inertia = pin.Inertia(float(base["mass_kg"]), np.array(base["com_m"]), symmetric(base["inertia_kg_m2"]))
        self.model.appendBodyToJoint(joint, inertia, here)
        disc = 0.5 * wheel["mass_kg"] * self.r**2
        axle = wheel.get("inertia_axle_kg_m2", disc)
        across = wheel.get("inertia_across_kg_m2", 0.5 * disc)
        for name, side in zip(WHEELS, (0.5, -0.5), strict=True):
            placement = pin.SE3(np.eye(3), np.array([0.0, side * self.track, self.r]))
            # About +y: its top moves ahead.
            turning = self.model.addJoint(joint, pin.JointModelRY(), placement, name)
            rotor = pin.Inertia(float(wheel["mass_kg"]), np.zeros(3), np.diag([across, axle, across]))
            self.model.appendBodyToJoint(turning, rotor, here)
        mount = pin.SE3(about_z(np.deg2rad(base["mount"]["yaw_deg"])), np.array(base["mount"]["position_m"]))
        self.motor = dict.fromkeys(WHEELS, wheel.get("motor"))
        self.damping = dict.fromkeys(WHEELS, wheel.get("damping_N_m_s_per_rad", 0.0))
        names = (self._serial if arm["type"] == "serial_arm" else self._urdf)(arm, mount)
        self.model.gravity = pin.Motion(np.array(arm.get("gravity_m_s2", [0.0, 0.0, -9.81])), np.zeros(3))
        self.joints = (*WHEELS, *names)
        for name in self.joints:
            if (motor := self.motor[name]) is not None and motor.get("mass_kg", 0.0) > 0.0:
                # A point on the body before its joint.
                here = self.model.getJointId(name)
                point = np.array(motor.get("mass_point_m", self.model.jointPlacements[here].translation))
                body = pin.Inertia(motor["mass_kg"], point, np.zeros((3, 3)))
                self.model.appendBodyToJoint(self.model.parents[here], body, pin.SE3.Identity())
        self.data = self.model.createData()
        self.index = np.array([self.model.joints[self.model.getJointId(name)].idx_v for name in self.joints])
        turning = ["X", "Y", "heading", *self.joints]
        assert sorted(turning) == sorted(self.model.names[1:])
        self.x, self.y, self.heading = (self.model.joints[self.model.getJointId(name)].idx_v for name in turning[:3])
        nv = self.model.nv
        self.loss, self.armature = np.zeros(nv), np.zeros(nv)
        for name, i in zip(self.joints, self.index, strict=True):
            self.loss[i] = self.damping.get(name, 0.0)
            if (motor := self.motor.get(name)) is not None and motor["type"] == "dc":
                square = motor["gear_ratio"] ** 2
                self.armature[i] = motor["rotor_inertia_kg_m2"] * square
                self.loss[i] += motor.get("gear_damping_N_m_s_per_rad", 0.0) * square

    def _serial(self, arm: dict[str, Any], placement: pin.SE3) -> list[str]:
        joint, names = self.body, []
        entries = [{**arm.get("link", {}), **entry} for entry in arm["chain"] for _ in range(entry.get("count", 1))]
        for number, entry in enumerate(entries, 1):
            axis = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}.get(str(entry["axis"]), entry["axis"])
            slides = entry.get("kind") == "prismatic"
            kind = pin.JointModelPrismaticUnaligned if slides else pin.JointModelRevoluteUnaligned
            names.append(f"joint_{number}")
            joint = self.model.addJoint(joint, kind(np.array(axis, dtype=float)), placement, names[-1])
            mass, length = entry["mass_kg"], entry["length_m"]
            com, tensor = np.array([0.0, 0.0, 0.5 * length]), entry.get("inertia_kg_m2")
            if tensor is None:
                square = entry["radius_m"] ** 2
                side = mass * (3.0 * square + length**2) / 12.0
                tensor = [side, 0.0, 0.0, side, 0.0, 0.5 * mass * square]
            body = pin.Inertia(mass, np.array(entry.get("com_m", com)), symmetric(tensor))
            self.model.appendBodyToJoint(joint, body, pin.SE3.Identity())
            placement = pin.SE3(np.eye(3), np.array([0.0, 0.0, length]))
            self.motor[names[-1]] = entry.get("motor")
            self.damping[names[-1]] = entry.get("damping_N_s_per_m" if slides else "damping_N_m_s_per_rad", 0.0)
        return names

    def _urdf(self, arm: dict[str, Any], placement: pin.SE3) -> list[str]:
        """Read the file with Pinocchio, which drops links fixed to the root."""
        read = pin.buildModelFromUrdf(arm["file"])
        joints = {joint.attrib["name"]: joint for joint in ElementTree.parse(arm["file"]).getroot().iter("joint")}
        # With a floating base the root's inertia is the inertia of its first joint.
        floating = pin.buildModelFromUrdf(arm["file"], pin.JointModelFreeFlyer())
        self.model.appendBodyToJoint(self.body, floating.inertias[1], placement)
        universe = read.inertias[0]
        read.inertias[0] = pin.Inertia.Zero()
        assert universe.mass in (0.0, floating.inertias[1].mass)
        body = self.model.addFrame(
            pin.Frame("mount", self.body, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME), append_inertia=False
        )
        self.model = pin.appendModel(self.model, read, body, placement)
        names = [name for name, joint in joints.items() if joint.attrib["type"] != "fixed"]
        for name in names:
            loss = joints[name].find("dynamics")
            self.damping[name] = 0.0 if loss is None else float(loss.attrib["damping"])
            self.motor[name] = arm["motors"].get(name)
        return names

    # ---- conversion of dynsim's coordinates (left, right, x, y in the axes of the start, arm) and rates

    def configuration(self, q: Array) -> Array:
        """Return the coordinates of this class, (nv,)."""
        left, right, x, y = q[:4]
        start, out = np.deg2rad(self.base["heading_deg"]), np.zeros(self.model.nv)
        out[[self.x, self.y]] = (np.array([*self.base["position_m"], 0.0]) + about_z(start) @ [x, y, 0.0])[:2]
        out[self.heading] = start + self.r / self.track * (right - left)
        out[self.index[:2]], out[self.index[2:]] = (left, right), q[4:]
        return out

    def rates(self, q: Array, v: Array) -> Array:
        """Return their rates for a rolling base."""
        heading, out = self.configuration(q)[self.heading], np.zeros(self.model.nv)
        speed = 0.5 * self.r * (v[0] + v[1])
        out[[self.x, self.y]] = speed * np.cos(heading), speed * np.sin(heading)
        out[self.heading] = self.r / self.track * (v[1] - v[0])
        out[self.index] = v
        return out

    def _coordinates(self, q: Array) -> Array:
        """Return Pinocchio's coordinates: cosine and sine for joints without limits."""
        out = np.zeros(self.model.nq)
        for joint in self.model.joints[1:]:
            angle = q[joint.idx_v]
            first, count = joint.idx_q, joint.nq
            out[np.arange(count) + first] = angle if count == 1 else (np.cos(angle), np.sin(angle))
        return out

    # ---- mechanics

    def rows(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return A, (3, nv), and the drift A v̇ of: no side slip, left wheel rolls, right wheel rolls."""
        c, s, w = np.cos(q[self.heading]), np.sin(q[self.heading]), v[self.heading]
        A, drift = np.zeros((3, self.model.nv)), np.zeros(3)
        A[0, [self.x, self.y]] = -s, c
        drift[0] = (c * v[self.x] + s * v[self.y]) * w
        for k, side in ((1, 0.5), (2, -0.5)):
            # The hub moves at V − ω (side T) ahead; the wheel subtracts r φ̇.
            A[k, [self.x, self.y]], A[k, self.heading], A[k, self.index[k - 1]] = (c, s), -side * self.track, -self.r
            drift[k] = (s * v[self.x] - c * v[self.y]) * w
        return A, drift

    def mass_matrix(self, q: Array) -> Array:
        """Return the mass matrix with rotors."""
        M = pin.crba(self.model, self.data, self._coordinates(q))
        return np.triu(M) + np.triu(M, 1).T + np.diag(self.armature)

    def bias_forces(self, q: Array, v: Array) -> Array:
        """Return the forces that v̇ = 0 requires, including losses."""
        return np.asarray(pin.nonLinearEffects(self.model, self.data, self._coordinates(q), v)) + self.loss * v

    def accelerations(
        self, q: Array, v: Array, tau: Array, J: Array | None = None, target: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """Return v̇, (nv,), the three multipliers, those of rows J v̇ = target, and the matrix of the system."""
        A, drift = self.rows(q, v)
        if J is not None and target is not None:
            A, drift = np.vstack([A, J]), np.concatenate([drift, target])
        K = np.block([[self.mass_matrix(q), -A.T], [A, np.zeros((len(A), len(A)))]])
        x = np.linalg.solve(K, np.concatenate([tau - self.bias_forces(q, v), drift]))
        return x[: self.model.nv], x[self.model.nv :], K

    def point(self, body: str, point: Array, q: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return Jacobian (3, nv), velocity and drift acceleration of a point on the base or on the link of a joint."""
        joint, coordinates = self.model.getJointId(body), self._coordinates(q)
        pin.forwardKinematics(self.model, self.data, coordinates, v, np.zeros(self.model.nv))
        pin.computeJointJacobians(self.model, self.data, coordinates)
        arm = self.data.oMi[joint].rotation @ point
        J = pin.getJointJacobian(self.model, self.data, joint, pin.LOCAL_WORLD_ALIGNED)
        rate = pin.getVelocity(self.model, self.data, joint, pin.LOCAL_WORLD_ALIGNED)
        drift = pin.getClassicalAcceleration(self.model, self.data, joint, pin.LOCAL_WORLD_ALIGNED)
        w = rate.angular
        return (
            J[:3] - pin.skew(arm) @ J[3:],
            rate.linear + np.cross(w, arm),
            drift.linear + np.cross(drift.angular, arm) + np.cross(w, np.cross(w, arm)),
        )

    def forces(self, q: Array, v: Array, vdot: Array) -> Array:
        """Return the motor forces at :attr:`joints` for these accelerations, including losses, with free multipliers.

        Unknowns: accelerations of the base, the multipliers and the forces.
        """
        A, drift = self.rows(q, v)
        nv, n = self.model.nv, len(self.index)
        h = self.bias_forces(q, v)
        B = np.zeros((nv, n))
        B[self.index, np.arange(n)] = 1.0
        K = np.zeros((nv + 3 + n, nv + 3 + n))
        K[:nv, :nv], K[:nv, nv : nv + 3], K[:nv, nv + 3 :] = self.mass_matrix(q), -A.T, -B
        K[nv : nv + 3, :nv], K[nv + 3 :, :nv] = A, B.T
        return np.linalg.solve(K, np.concatenate([-h, drift, vdot]))[nv + 3 :]
