"""Controllers, the paths of hand and base, operators, and commanded braces."""

from messages.case import Edits, Overrides

AREA = "Controllers and paths"
ORDER = 40

ARM = """\
duration_s: 2
plant:
  type: serial_arm
  base: {position_m: [0, 0, 0.3]}
  chain:
    - {axis: z, motor: {type: wang_minami}}
    - {axis: y, count: 2, length_m: 0.2, initial_deg: 40, motor: {type: wang_minami}}
    - {kind: prismatic, axis: x, length_m: 0.1}  # without a motor
surfaces: {floor: {type: plane}}
contacts: {law: unilateral, points: {elbow: {body: link_3}}}
controller:
  type: joint_pd
"""
PATH = """\
t_s,x_m,y_m,z_m
0,0.3,0,0.6
1,0.3,0.1,0.6
2,0.3,0,0.6
"""
CHECK = 'dynsim.check(dynsim.load_scenario("arm.yaml"))'
FOLLOWING = f"{ARM}  hand:\n    joints: [joint_1, joint_2, joint_3]\n    path: {{type: csv, file: path.csv}}\n"
TIMES = "times_s: [0, 1]"
LINE = "path: {type: line, from_m: [0.3, 0, 0.6], to_m: [0.3, 0.1, 0.6], duration_s: 1}"


def waypoints(keys: str) -> str:
    return f"  joints: {{joint_2: {{{keys}}}}}\n"


def circle(keys: str) -> str:
    return f"  hand: {{joints: [joint_1], path: {{type: circle, center_m: [0.3, 0, 0.6], period_s: 1, {keys}}}}}\n"


TABLES = [
    Edits(
        CHECK,
        {"arm.yaml": ARM},
        [
            ("unknown controller", "type: joint_pd", "type: joint_pdd"),
            ("controller of a snake for an arm", "type: joint_pd", "type: task_space"),
            ("misspelt gain", "  k_p: 500\n"),
            ("negative gain", "  k_p_V_per_rad: -1\n"),
            ("gains of too many joints", "  k_p_V_per_rad: [1, 2, 3, 4, 5, 6]\n"),
            ("knots that are too close", "  knot_spacing_s: 1.0e-9\n  feed_forward: gravity\n"),
            ("sample time of zero", "  sample_time_s: 0\n"),
            (
                "waypoints of a joint that does not exist",
                waypoints(f"{TIMES}, angles_deg: [0, 10]").replace("joint_2", "joint_9"),
            ),
            (
                "waypoints of a joint without a motor",
                waypoints(f"{TIMES}, positions_m: [0, 0.1]").replace("joint_2", "joint_4"),
            ),
            ("waypoints without values", waypoints(TIMES)),
            ("waypoints in degrees and metres", waypoints(f"{TIMES}, angles_deg: [0, 10], positions_m: [0, 1]")),
            ("waypoints of a hinge in metres", waypoints(f"{TIMES}, positions_m: [0, 0.1]")),
            ("more times than waypoints", waypoints("times_s: [0, 1, 2], angles_deg: [0, 10]")),
            ("times that do not increase", waypoints("times_s: [0, 0], angles_deg: [0, 10]")),
            ("a single waypoint", waypoints("times_s: [0], angles_deg: [0]")),
            ("torque of a motor with a circuit", "  torques: {joint_2: {times_s: [0, 1], torques_N_m: [0, 1]}}\n"),
            (
                "waypoints of a motor of type torque",
                "initial_deg: 40, motor: {type: wang_minami}",
                "motor: {type: torque, limit_N_m: 1}",
                "type: joint_pd\n",
                f"type: joint_pd\n{waypoints(f'{TIMES}, angles_deg: [0, 10]')}",
            ),
            ("hand without a path", "  hand: {joints: [joint_1]}\n"),
            (
                "hand without joints",
                f"  hand: {{joints: [], {LINE}}}\n",
            ),
            ("unknown path", "  hand: {joints: [joint_1], path: {type: spiral}}\n"),
            (
                "path of a joint that also has waypoints",
                f"  hand: {{joints: [joint_2], {LINE}}}\n{waypoints(f'{TIMES}, angles_deg: [0, 10]')}",
            ),
            (
                "circle of radius zero",
                circle("radius_m: 0, normal: [0, 0, 1]"),
            ),
            (
                "circle without direction",
                circle("radius_m: 0.1, normal: [0, 0, 0]"),
            ),
            ("brace with a negative force", "  brace: {elbow: -1}\n"),
            ("brace with times that overlap", "  brace: {elbow: {during_s: [[0, 2], [1, 3]]}}\n"),
            ("brace with an unknown key", "  brace: {elbow: {during: [[0, 2]]}}\n"),
            ("brace that is not a contact", "  brace: {elbo: 1}\n"),
            ("brace of an unknown kind", "  brace: best\n"),
            (
                "brace in the air",
                "type: joint_pd",
                "type: joint_pd\n  brace: {elbow: 1}",
                "    - {kind: prismatic, axis: x, length_m: 0.1}  # without a motor\n",
                "",
            ),
            ("brace with another feed-forward", "  brace: optimal\n  feed_forward: gravity\n"),
            ("least force without optimal braces", "  min_N: 2\n"),
            ("unknown feed-forward", "  feed_forward: inertia\n"),
            (
                "operator with planned references",
                f"  operator: {{joints: [joint_1]}}\n{waypoints(f'{TIMES}, angles_deg: [0, 10]')}",
            ),
            (
                "commands of an operator out of order",
                "  operator: {joints: [joint_1], commands: [{at_s: 1, hand: [0, 0, 0]}, {at_s: 0, hand: [0, 0, 0]}]}\n",
            ),
            ("command of the hand without joints", "  operator: {commands: [{at_s: 0, hand: [0, 0, 0.1]}]}\n"),
            ("path of a base that stands fixed", "  base: {path: {type: hold}}\n"),
            ("encoders of a continuous controller", "sensors: {encoders: {delay_s: 0.01}}\n"),
            ("motion capture of an arm", "sensors: {motion_capture: {rate_hz: 100}}\n"),
            ("planned voltages of an arm with a joint that has no motor", "  feed_forward: dynamics\n"),
        ],
    ),
    Edits(
        CHECK,
        {"arm.yaml": FOLLOWING, "path.csv": PATH},
        [
            ("table without a header", "t_s,x_m,y_m,z_m\n", ""),
            ("table with another header", "t_s,x_m,y_m,z_m", "t,x,y,z"),
            ("table with a text", "1,0.3,0.1,0.6", "1,0.3,left,0.6"),
            ("table with a decimal comma", "1,0.3,0.1,0.6", "1,0,3,0.1,0.6"),
            ("table with a missing value", "1,0.3,0.1,0.6", "1,0.3,,0.6"),
            ("table with a short row", "1,0.3,0.1,0.6", "1,0.3,0.1"),
            ("table with infinity", "1,0.3,0.1,0.6", "1,0.3,inf,0.6"),
            ("table with a time twice", "1,0.3,0.1,0.6", "0,0.3,0.1,0.6"),
            ("table of a single row", "1,0.3,0.1,0.6\n2,0.3,0,0.6\n", ""),
            ("table with rows that are too close in time", "1,0.3,0.1,0.6", "1e-300,0.3,0.1,0.6"),
        ],
        keyed=False,
    ),
    Edits(
        CHECK,
        {"arm.yaml": FOLLOWING, "path.csv": PATH},
        [
            ("table that does not exist", "file: path.csv", "file: paths.csv"),
            ("folder as table", "file: path.csv", "file: ."),
            ("table that leads very far", "file: path.csv", "file: path.csv", "1,0.3,0.1,0.6", "1,0.3,1e300,0.6"),
            (
                "path that the hand cannot reach",
                "{type: csv, file: path.csv}",
                "{type: line, from_m: [3, 0, 0.6], to_m: [4, 0, 0.6], duration_s: 1}",
            ),
        ],
    ),
    Overrides(
        "elbow_comparison",
        [
            ("circle that is too large for the arm", {"controller.hand.path.radius_m": 0.6}),
            ("circle out of reach", {"controller.hand.path.center_m": [9, 9, 9]}),
            ("hand moved by a single joint", {"controller.hand.joints": ["joint_1"]}),
            ("hand moved by a joint that does not exist", {"controller.hand.joints": ["joint_1", "joint_11"]}),
        ],
    ),
    Overrides(
        "mobile_elbow_comparison_driving",
        [
            ("wheel as a joint of the hand", {"controller.hand.joints": ["base.left", "joint_9"]}),
            (
                "waypoints of a wheel on a path",
                {"controller.joints": {"base.left": {"times_s": [0, 1], "angles_deg": [0, 9]}}},
            ),
            ("path of the base that is not known", {"controller.base.path": {"type": "zigzag"}}),
            (
                "path of the base that begins elsewhere",
                {"controller.base.path": {"type": "waypoints", "times_s": [0, 9], "points_m": [[1, 1], [2, 2]]}},
            ),
            (
                "path of the base that begins sideways",
                {
                    "controller.base.path": {
                        "type": "waypoints",
                        "times_s": [0, 9],
                        "points_m": [[0, 0], [0, 1]],
                        "frame": "start",
                    }
                },
            ),
            (
                "path of the base with a corner",
                {
                    "controller.base.path": {
                        "type": "waypoints",
                        "times_s": [0, 3, 6, 9],
                        "points_m": [[0, 0], [0.5, 0], [1, 0], [0.5, 0]],
                        "frame": "start",
                    }
                },
            ),
            (
                "path of the base with a point twice",
                {
                    "controller.base.path": {
                        "type": "waypoints",
                        "times_s": [0, 3, 6],
                        "points_m": [[0, 0], [0.5, 0], [0.5, 0]],
                    }
                },
            ),
            ("table of the base that does not exist", {"controller.base.path": {"type": "csv", "file": "nowhere.csv"}}),
            (
                "hand that loses reach as the base drives",
                {"controller.base.path": {"type": "straight", "distance_m": -1.0, "duration_s": 10}},
            ),
        ],
    ),
]
