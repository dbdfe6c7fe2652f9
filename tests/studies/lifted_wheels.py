"""Wheel pairs of a snake on servos, posed in Pinocchio, and the study of their heights and directions.

``PYTHONPATH=tests python -m studies.lifted_wheels`` writes results/snake/lifted_wheels.json, which
docs/hardware/lifted-wheels.md quotes. The robot gets the recorded head pose and the angles sent to the servos, but no
data of the base.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.optimize import linprog

from dynsim._version import __version__
from dynsim.engine import simulate
from dynsim.hardware.bus.control_table import RAD_PER_TICK
from dynsim.hardware.replay.trajectory import path_of_record
from dynsim.hardware.servo_map import SHIPPED, ServoMap, load_servo_map
from dynsim.record import Record
from dynsim.scenario import load_scenario
from dynsim.snake.lifting import Lifts, lifted
from dynsim.system.files import write_json

FILE = Path("results/snake/lifted_wheels.json")
# Records with bases from nearly straight to bent in a zigzag.
RECORDS = (("snake_operator", None), ("snake_positioning", "y"), ("snake_joint_limits", "cyclic"))

LINK, RADIUS, GRIPPER = 0.0905, 0.05, 0.09  # [T] Table I, IV.B
HALF_TRACK = np.array([0.075, 0.06, 0.075, 0.06, 0.075, 0.06, 0.06])
CLEARANCE, BLEND = 5e-3, 0.3  # values of the shipped map
JOINTS = [f"{kind}{k}" for k in range(1, 10) for kind in ("theta", "psi")][:-1]  # theta1, psi1 ... psi8, theta9
PITCH = tuple(f"psi{k}" for k in range(3, 9))


class Oracle:
    """Chain of all 18 joints, one revolute joint each, neighbours one link apart."""

    def __init__(self) -> None:
        self.model = pin.Model()
        parent, placement = 0, pin.SE3.Identity()
        for name in JOINTS:
            kind = pin.JointModelRZ() if name.startswith("theta") else pin.JointModelRY()
            placement = pin.SE3(np.eye(3), np.array([-LINK, 0.0, 0.0]))
            parent = self.model.addJoint(parent, kind, placement, name)
        self.data = self.model.createData()
        self.axle = [self.model.getJointId(name) for name in PITCH] + [parent]
        self.tail = pin.SE3(np.eye(3), np.array([-LINK, 0.0, 0.0]))

    def from_head(self, w: np.ndarray, offset: float, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return axle centres (7, 3), axle directions (7, 3) and heights of the wheels' lowest points (7, 2) [m]."""
        head = pin.SE3(pin.rpy.rpyToMatrix(*w[3:]), w[:3]) * pin.SE3(np.eye(3), np.array([-offset, 0.0, 0.0]))
        return self._seen(head, q)

    def from_pair_1(self, psi_3: float, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the same with pair 1 flat on the floor at the origin; ``psi_3``: recorded angle, without lift."""
        pin.forwardKinematics(self.model, self.data, q)
        lifting = pin.SE3(pin.rpy.rpyToMatrix(0.0, q[JOINTS.index("psi3")] - psi_3, 0.0), np.zeros(3))
        floor = self.data.oMi[self.axle[0]] * lifting.inverse()
        return self._seen(pin.SE3(np.eye(3), np.array([0.0, 0.0, RADIUS])) * floor.inverse(), q)

    def _seen(self, head: pin.SE3, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        pin.forwardKinematics(self.model, self.data, q)
        poses = [head * self.data.oMi[joint] for joint in self.axle]
        poses[-1] = poses[-1] * self.tail
        middle = np.array([pose.translation for pose in poses])
        axle = np.array([pose.rotation[:, 1] for pose in poses])
        bottom = middle[:, 2] - RADIUS * np.sqrt(1.0 - axle[:, 2] ** 2)
        beside = HALF_TRACK * axle[:, 2]
        return middle, axle, np.column_stack([bottom + beside, bottom - beside])


@dataclass
class Posed:
    """A record posed on the oracle at all its samples."""

    record: Record
    middle: np.ndarray  # (T, 7, 3)
    axle: np.ndarray  # (T, 7, 3)
    wheel: np.ndarray  # (T, 7, 2)

    @property
    def grounded(self) -> np.ndarray:
        return self.record["grounded"] == 1

    @property
    def lower(self) -> np.ndarray:
        return self.wheel.min(axis=2)


def snake_map() -> ServoMap:
    """Return the shipped map of the snake."""
    return load_servo_map(SHIPPED / "snake.yaml")


def head_offset(record: Record) -> float:
    """Return the distance from the first joint to the controlled point, minus one link [m]."""
    return record.scene.hand.position[0] - LINK


def posed(record: Record, servo_map: ServoMap) -> Posed:
    """Pose the robot at all samples of a record, with the recorded head pose and the angles sent by the map."""
    oracle, angles = Oracle(), angles_sent(record, servo_map)
    poses = [oracle.from_head(w, head_offset(record), q) for w, q in zip(record["w"], angles, strict=True)]
    return Posed(record, *(np.array(part) for part in zip(*poses, strict=True)))


def settled(record: Record) -> np.ndarray:
    """Return a mask of samples at which a pair was lifted for the blend time before and after."""
    away, time = record["grounded"] == 0, record.time
    angles = np.zeros_like(away)
    for pair in range(away.shape[1]):
        for row in np.flatnonzero(away[:, pair]):
            near = np.abs(time - time[row]) < BLEND + 1e-9
            angles[row, pair] = away[near, pair].all()
    return angles


def with_lifts(servo_map: ServoMap, **changes: object) -> ServoMap:
    """Return the map with different settings of `lifts`."""
    servo_map.lifts = Lifts.model_validate(servo_map.lifts.model_dump() | changes)
    return servo_map


def best_deviation(yaw: np.ndarray, away: set[int]) -> float:
    """Return the least possible maximum height error of grounded wheels [m], to first order, over all pitch angles.

    A linear programme: pitch joint j lifts the links behind it in proportion to their distance from axle j; lifted
    wheels are at the clearance or above, pair 1 is flat.
    """
    middle, axle, heading = [np.zeros(2)], [np.array([0.0, 1.0])], 0.0
    for angle in yaw:
        ahead = np.array([np.cos(heading), np.sin(heading)])
        heading += angle
        behind = np.array([np.cos(heading), np.sin(heading)])
        middle.append(middle[-1] - LINK * ahead - LINK * behind)
        axle.append(np.array([-behind[1], behind[0]]))
    rows, bounds = [], []
    for i in range(1, 7):
        for side in (1, -1):
            wheel = middle[i] + side * HALF_TRACK[i] * axle[i]
            lift = [(middle[j] - wheel) @ [axle[j][1], -axle[j][0]] if j < i else 0.0 for j in range(6)]
            if i + 1 in away:
                rows.append([*(-np.array(lift)), 0.0])
                bounds.append(-CLEARANCE)
            else:
                rows += [[*lift, -1.0], [*(-np.array(lift)), -1.0]]
                bounds += [0.0, 0.0]
    optimum = linprog([*[0.0] * 6, 1.0], A_ub=rows, b_ub=bounds, bounds=[(None, None)] * 6 + [(0.0, None)])
    return float(optimum.x[-1])


def angles_sent(record: Record, servo_map: ServoMap) -> np.ndarray:
    """Return the angles of all 18 joints sent to the servos at the samples of the record, (T, 18) [rad]."""
    path = path_of_record(record, servo_map)
    columns = [servo_map.joints.index(name) for name in JOINTS]
    first = int(np.searchsorted(path.time, 0.0))
    return path.position[first : first + len(record), columns]


def second_order(poses: Posed) -> tuple[float, float]:
    """Return the largest deviation of grounded axles from the recorded base: along the floor [m], heading [rad]."""
    record = poses.record
    flat = record["posture"][:, 6::2, :2]  # after the controlled point and five joints
    off = np.linalg.norm(poses.middle[..., :2] - flat, axis=2)[poses.grounded].max()
    yaw = np.cumsum(np.column_stack([record["base_pose"][:, 2], record["phi"][:, 6:]]), axis=1)
    along = np.cos(yaw) * poses.axle[..., 0] + np.sin(yaw) * poses.axle[..., 1]  # sine of the axles' error in yaw
    return float(off), float(np.abs(along[poses.grounded]).max())


def other_wheel(record: Record) -> dict[str, float]:
    """Return for a bent base: largest yaw angle [deg], largest height of the other wheel of a grounded pair [mm]."""
    fold = lifted(record, Lifts(joints=PITCH, tilt_mm=1e3))
    yaw = np.degrees(np.abs(record["phi"][:, 6:]).max())
    return {"yaw_deg": float(yaw), "other_wheel_mm": float(1e3 * fold.tilt[record["grounded"] == 1].max())}


def in_ticks(record: Record) -> dict[str, float]:
    """Return wheel heights with angles rounded to servo ticks, with pair 1 flat on the floor [mm]."""
    oracle, exact = Oracle(), posed(record, snake_map())
    psi_3 = _to_ticks(record["phi"][:, record.labels["phi"].index("psi3")])
    angles = _to_ticks(angles_sent(record, snake_map()))
    wheel = np.array([oracle.from_pair_1(*row)[2] for row in zip(psi_3, angles, strict=True)])
    off = (wheel - exact.wheel)[exact.grounded]
    return {
        "off_rms_mm": float(1e3 * np.sqrt(np.mean(off**2))),
        "off_max_mm": float(1e3 * np.abs(off).max()),
        "clear_mm": float(1e3 * wheel[settled(record)].min()),
    }


def _to_ticks(angles: np.ndarray) -> np.ndarray:
    return np.round(angles / RAD_PER_TICK) * RAD_PER_TICK


def study() -> dict[str, Any]:
    """Return the numbers quoted in docs/hardware/lifted-wheels.md."""
    records = {name: simulate(load_scenario(name, variant)) for name, variant in RECORDS}
    operator = records["snake_operator"]
    poses = posed(operator, snake_map())
    tilt = np.ptp(poses.wheel, axis=2) * poses.grounded
    row = int(tilt.max(axis=1).argmax())
    off, heading = second_order(poses)
    away = set(np.flatnonzero(~poses.grounded[row]) + 1)
    return {
        "dynsim_version": __version__,
        "records": {name: other_wheel(record) for name, record in records.items()},
        "least_deviation_mm": 1e3 * best_deviation(operator["phi"][row, 6:], away),
        "grounded_axle_off_mm": 1e3 * off,
        "grounded_axle_off_mrad": 1e3 * heading,
        "in_ticks": in_ticks(operator),
    }


if __name__ == "__main__":
    write_json(FILE, study())
