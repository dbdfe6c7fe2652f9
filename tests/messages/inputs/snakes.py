"""Snakes: their build, controller, modes, commands and gripper."""

from messages.case import Edits, Overrides

AREA = "Snakes"
ORDER = 60

SNAKE = """\
duration_s: 0.05
plant: {type: snake}
controller:
  type: task_space
"""
CHECK = 'dynsim.check(dynsim.load_scenario("snake.yaml"))'


def command(keys: str) -> str:
    return f"  commands: [{{at_s: 0, velocity: [0.1, 0, 0, 0, 0, 0]}}, {{at_s: 1, {keys}}}]\n"


TABLES = [
    Edits(
        CHECK,
        {"snake.yaml": SNAKE},
        [
            ("odd number of head joints", "{type: snake}", "{type: snake, head_joints: 5}"),
            ("too few head joints", "{type: snake}", "{type: snake, head_joints: 2}"),
            ("snake without a base part", "{type: snake}", "{type: snake, yaw_joints: 3}"),
            ("snake of a single joint", "{type: snake}", "{type: snake, yaw_joints: 1}"),
            ("snake without driven wheels", "{type: snake}", "{type: snake, yaw_joints: 4, driven_side: none}"),
            ("gaps for too few wheel pairs", "{type: snake}", "{type: snake, wheel_gap_m: [0.1, 0.1]}"),
            ("unknown side of the drive", "{type: snake}", "{type: snake, driven_side: front}"),
            ("too few initial angles of a snake", "{type: snake}", "{type: snake, initial_joints_rad: [0, 0, 0]}"),
            (
                "initial angle beyond its limit",
                "{type: snake}",
                "{type: snake, initial_joints_rad: [0, -3, 0, 0, 0, 0]}",
            ),
            (
                "initial posture that is singular",
                "{type: snake}",
                "{type: snake, initial_joints_rad: [0, 0, 0, 0, 0, 0]}",
            ),
            ("unknown level", "{type: snake}", "{type: snake, level: static}"),
            (
                "stop within a limit of the command",
                "{type: snake}",
                "{type: snake, level: dynamic, dynamics: {stops_deg: {yaw: 30}}}",
            ),
            (
                "servo of the joints that follows rates",
                "{type: snake}",
                "{type: snake, level: dynamic, dynamics: {joint_servo: {type: mx_28}}}",
            ),
            ("capture distance of zero", "{type: snake}", "{type: snake, gripper: {capture_m: 0}}"),
            ("robot too short for the default modes", "{type: snake}", "{type: snake, yaw_joints: 4}"),
            ("no modes", "  modes: {}\n"),
            ("mode of a wheel pair that does not exist", "  modes: {1: [9]}\n"),
            ("mode of number zero", "  modes: {0: [3, 6]}\n"),
            ("mode that lifts too many wheels", "  modes: {1: [2, 3, 4, 5, 6, 7]}\n  switching: {order: [1]}\n"),
            ("unknown fixing mode", "  fixing_mode: 9\n"),
            ("true as fixing mode", "  fixing_mode: true\n"),
            ("unknown mode in the order", "  switching: {order: [1, 44]}\n"),
            ("unknown policy of switching", "  switching: {policy: random}\n"),
            ("shape point that is not a joint", "  shape_points_rad: {theta99: 0}\n"),
            ("shape point beyond its limit", "  shape_points_rad: {theta1: 3}\n"),
            ("too many shape points", "  shape_points_rad: {theta1: 0, psi1: 0, theta2: 0}\n"),
            ("weights of too few joints", "  weight_joint: [1, 1]\n"),
            ("control period of zero", "  period_s: 0\n"),
            ("control period longer than the run", "  period_s: 0.1\n"),
            ("rate that does not divide the control rate", "record: {rate_hz: 30}\n"),
            ("unknown state of the controller", "  state: known\n"),
            ("unknown mode by number", command("mode: -7")),
            ("misspelt mode", command("mode: swithcing")),
            ("true as mode", command("mode: true")),
            ("command of two velocities", command("velocity: [0.1, 0]")),
            ("command of seven velocities", command("velocity: [0, 0, 0, 0, 0, 0, 0]")),
            ("command with an unknown key", command("velocty: [0, 0, 0, 0, 0, 0]")),
            ("commands out of order", command("mode: 1").replace("at_s: 0", "at_s: 2")),
            ("unknown state of the gripper", command("gripper: shut")),
            ("unknown path of the head", "  paths: [{type: spiral}]\n"),
            (
                "path of three coordinates",
                "  paths: [{type: ramp, start_s: 0, duration_s: 1, displacement: [1, 0, 0]}]\n",
            ),
            (
                "contacts of a kinematic snake",
                "contacts: {points: {nose: {body: head}}}\nsurfaces: {floor: {type: plane}}\n",
            ),
            ("load of a kinematic snake", "loads: {pull: {type: constant, body: head, force_N: [1, 0, 0]}}\n"),
            ("wrench sensor of a kinematic snake", "sensors: {wrench: {neck: {body: head}}}\n"),
            ("controller of an arm for a snake", "type: task_space", "type: joint_pd"),
            ("snake without a controller", "controller:\n  type: task_space\n", ""),
            (
                "step that does not divide the control period",
                "{type: snake}",
                "{type: snake, level: dynamic}",
                "duration_s: 0.05",
                "duration_s: 0.05\nintegrator: {step_s: 0.002}",
            ),
            (
                "mode that lifts the pair of the head",
                "{type: snake}",
                "{type: snake, level: dynamic}",
                "type: task_space",
                "type: task_space\n  modes: {1: [3, 6], 2: [1]}\n  switching: {order: [1, 2]}",
            ),
        ],
    ),
    Overrides(
        "snake_valve",
        [
            (
                "gripper that closes too far from the valve",
                {
                    "controller.commands": [{"at_s": 0.05, "gripper": "closed"}],
                    "duration_s": 0.1,
                    "controller.paths": [],
                },
                "turns",
            ),
        ],
        run=True,
    ),
]
