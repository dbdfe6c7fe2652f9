"""Rated values of Dynamixel servos and robot joints from public data sheets; simulation and hardware share this table.

The data sheet of a servo is its page in the e-manual of ROBOTIS, see :attr:`ServoSheet.source`. Values that a source
does not contain are marked as assumed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

RPM = 2 * math.pi / 60
"""One revolution per minute [rad/s]."""
GEAR_FRICTION = 0.02
"""Dry friction of the gear of a Dynamixel servo as a fraction of its stall torque (assumed)."""


@dataclass(frozen=True)
class ServoSheet:
    """Data sheet of a Dynamixel servo; all values hold at its output shaft.

    Attributes
    ----------
    name : str
    number : int
        Model number in the control table.
    rated_voltage : float
        Supply voltage of the other values [V].
    no_load_rpm, stall_torque, stall_current : float
        Speed without load [rev/min], and torque [N m] and current [A] of the stalled servo.
    highest_voltage : float
        Maximum recommended supply voltage [V].
    """

    name: str
    number: int
    rated_voltage: float
    no_load_rpm: float
    stall_torque: float
    stall_current: float
    highest_voltage: float = 14.8

    @property
    def no_load_speed(self) -> float:
        """Maximum speed without load at the rated voltage [rad/s]."""
        return self.no_load_rpm * RPM

    @property
    def source(self) -> str:
        """Address of the data sheet."""
        page = f"x/{self.name}" if self.name[0] == "X" else f"mx/{self.name}-2"
        return f"https://emanual.robotis.com/docs/en/dxl/{page.lower()}/"

    @property
    def motor_type(self) -> str:
        """Value of ``type`` for a motor in a scenario."""
        return self.name.lower().replace("-", "_")


SERVO_SHEETS = {
    sheet.name: sheet
    for sheet in (
        # Name, model number, voltage [V], no-load speed [rev/min], stall torque [N m] and current [A].
        ServoSheet("MX-106", 321, 12.0, 45, 8.4, 5.2),
        ServoSheet("MX-64", 311, 12.0, 63, 6.0, 4.1),
        ServoSheet("MX-28", 30, 12.0, 55, 2.5, 1.4),
        ServoSheet("XL330-M077", 1190, 5.0, 383, 0.215, 1.47, 6.0),
        ServoSheet("XL330-M288", 1200, 5.0, 103, 0.52, 1.47, 6.0),
        ServoSheet("XL430-W250", 1060, 12.0, 61, 1.5, 1.4),
        ServoSheet("XC430-W150", 1070, 12.0, 106, 1.6, 1.4),
        ServoSheet("XC430-W240", 1080, 12.0, 70, 1.9, 1.4),
        ServoSheet("XM430-W210", 1030, 12.0, 77, 3.0, 2.3),
        ServoSheet("XM430-W350", 1020, 12.0, 46, 4.1, 2.3),
        ServoSheet("XM540-W150", 1130, 12.0, 53, 7.3, 4.4),
        ServoSheet("XM540-W270", 1120, 12.0, 30, 10.6, 4.4),
        ServoSheet("XH540-W150", 1110, 12.0, 70, 7.1, 4.9),
        ServoSheet("XH540-W270", 1100, 12.0, 39, 9.9, 4.9),
    )
}
"""Mapping from names to Dynamixel servos with Protocol 2.0."""


@dataclass(frozen=True)
class JointSheet:
    """Data sheet of a joint of an industrial robot, with its motor, gear and position controller.

    Attributes
    ----------
    name : str
        Value of ``type`` for a motor in a scenario.
    joints : str
        Robot and joints.
    torque, speed : float
        Maximum torque [N m] and speed [rad/s].
    stiffness, damping : float
        Gains of the position loop [N m/rad, N m s/rad] (assumed).
    source : str
        Source of torque and speed.
    """

    name: str
    joints: str
    torque: float
    speed: float
    stiffness: float
    damping: float
    source: str


_PANDA = "https://frankaemika.github.io/docs/control_parameters.html, limits for Panda"
_UR5E = "https://www.universal-robots.com/articles/ur-articles/max-joint-torques; speed: user manual of the UR5e"
_IIWA = (
    "https://www.kuka.com/-/media/kuka-downloads/imported/48ec812b1b2947898ac2598aff70abc0/spez_lbr_iiwa_en.pdf, "
    "axis data; torques: KUKA brochure LBR iiwa, technical data (as in iiwa_description of Drake)"
)
_DEG = math.pi / 180
# The gains are the gains of the position actuators in mujoco_menagerie (franka_emika_panda, universal_robots_ur5e and
# kuka_iiwa_14).
JOINT_SHEETS = {
    sheet.name: sheet
    for sheet in (
        # Name, joints, maximum torque [N m] and speed [rad/s], assumed gains [N m/rad, N m s/rad], source.
        JointSheet("panda_large", "Franka Emika Panda, joints 1 to 4", 87.0, 2.175, 3500.0, 350.0, _PANDA),
        JointSheet("panda_small", "Franka Emika Panda, joints 5 to 7", 12.0, 2.61, 2000.0, 200.0, _PANDA),
        JointSheet("ur5e_large", "UR5e, base, shoulder and elbow", 150.0, 180 * _DEG, 2000.0, 400.0, _UR5E),
        JointSheet("ur5e_small", "UR5e, wrists 1 to 3", 28.0, 180 * _DEG, 500.0, 100.0, _UR5E),
        JointSheet("iiwa7_a1", "LBR iiwa 7 R800, axes 1 and 2", 176.0, 98 * _DEG, 2000.0, 200.0, _IIWA),
        JointSheet("iiwa7_a3", "LBR iiwa 7 R800, axis 3", 110.0, 100 * _DEG, 2000.0, 200.0, _IIWA),
        JointSheet("iiwa7_a4", "LBR iiwa 7 R800, axis 4", 110.0, 130 * _DEG, 2000.0, 200.0, _IIWA),
        JointSheet("iiwa7_a5", "LBR iiwa 7 R800, axis 5", 110.0, 140 * _DEG, 2000.0, 200.0, _IIWA),
        JointSheet("iiwa7_a6", "LBR iiwa 7 R800, axes 6 and 7", 40.0, 180 * _DEG, 2000.0, 200.0, _IIWA),
        JointSheet("iiwa14_a1", "LBR iiwa 14 R820, axes 1 and 2", 320.0, 85 * _DEG, 2000.0, 200.0, _IIWA),
        JointSheet("iiwa14_a3", "LBR iiwa 14 R820, axis 3", 176.0, 100 * _DEG, 2000.0, 200.0, _IIWA),
        JointSheet("iiwa14_a4", "LBR iiwa 14 R820, axis 4", 176.0, 75 * _DEG, 2000.0, 200.0, _IIWA),
        JointSheet("iiwa14_a5", "LBR iiwa 14 R820, axis 5", 110.0, 130 * _DEG, 2000.0, 200.0, _IIWA),
        JointSheet("iiwa14_a6", "LBR iiwa 14 R820, axes 6 and 7", 40.0, 135 * _DEG, 2000.0, 200.0, _IIWA),
    )
}
"""Mapping from types of motor to joints of industrial robots."""
