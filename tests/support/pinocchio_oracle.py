"""A robot of revolute and prismatic joints in Pinocchio: mass matrix, and motion and Jacobian of points."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from dynsim.model.description import Robot


class Oracle:
    """A robot in Pinocchio, with its joints in depth-first order (which Pinocchio's algorithms assume)."""

    def __init__(self, robot: Robot) -> None:
        self.model = pin.Model()
        self.model.gravity = pin.Motion(robot.gravity, np.zeros(3))
        index = {None: 0}
        self.order: list[int] = []
        names = [link.name for link in robot.links]
        kinds = {"prismatic": pin.JointModelPrismaticUnaligned, "revolute": pin.JointModelRevoluteUnaligned}

        def add(parent: str | None) -> None:
            for link in robot.links:
                if link.parent == parent:
                    kind = kinds[link.kind](link.axis)
                    joint = self.model.addJoint(index[parent], kind, pin.SE3(link.R_PJ, link.p_PJ), link.joint)
                    body = pin.Inertia(link.inertia.mass, link.inertia.com, link.inertia.tensor)
                    self.model.appendBodyToJoint(joint, body, pin.SE3.Identity())
                    index[link.name] = joint
                    self.order.append(names.index(link.name))
                    add(link.name)

        add(None)
        self.joint = [index[name] for name in names]
        self.data = self.model.createData()

    def to(self, x: np.ndarray) -> np.ndarray:
        """Return a joint vector of dynsim in Pinocchio's order."""
        return x[self.order]

    def back(self, x: np.ndarray) -> np.ndarray:
        """Return a joint vector of Pinocchio in dynsim's order, along the last axis."""
        out = np.empty_like(x)
        out[..., self.order] = x
        return out

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        M = pin.crba(self.model, self.data, self.to(q))
        M = np.triu(M) + np.triu(M, 1).T
        return self.back(self.back(M).T)

    def point(self, body: int, point: np.ndarray, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return position, Jacobian (3, n), velocity and drift acceleration of a body-fixed point."""
        pin.forwardKinematics(self.model, self.data, self.to(q), self.to(v), np.zeros(len(q)))
        pin.computeJointJacobians(self.model, self.data, self.to(q))
        M, j = self.data.oMi[self.joint[body]], self.joint[body]
        arm = M.rotation @ point
        J6 = pin.getJointJacobian(self.model, self.data, j, pin.LOCAL_WORLD_ALIGNED).reshape(6, -1)
        J = J6[:3] - pin.skew(arm) @ J6[3:]
        velocity = pin.getVelocity(self.model, self.data, j, pin.LOCAL_WORLD_ALIGNED)
        acceleration = pin.getClassicalAcceleration(self.model, self.data, j, pin.LOCAL_WORLD_ALIGNED)
        w = velocity.angular
        drift = acceleration.linear + np.cross(acceleration.angular, arm) + np.cross(w, np.cross(w, arm))
        return M.translation + arm, self.back(J), velocity.linear + np.cross(w, arm), drift
