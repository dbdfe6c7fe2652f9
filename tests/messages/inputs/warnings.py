"""Warnings of checks and of short runs, and runs that stop."""

from messages.case import Edits, Overrides

AREA = "Warnings and stops of runs"
ORDER = 80

SHORT = {"duration_s": 0.05, "metrics.settle_s": 0.0}
FLOOR = "elbow_comparison_floor"
LATE = {"type": "line", "from_m": [1, 1, 0.5], "to_m": [1, 1.1, 0.5], "start_s": 9, "duration_s": 1}
PUSH = {"type": "samples", "body": "link_4", "times_s": [3, 4], "force_N": [[1, 0, 0], [1, 0, 0]]}
HANGING = """\
duration_s: 0.1
plant:
  type: serial_arm
  base: {position_m: [0, 0, 0.3]}
  chain: [{axis: z}, {axis: y, count: 3, length_m: 0.2}]
surfaces: {floor: {type: plane}, thing: {type: plane, point_m: [0, 0, 0.55]}}
metrics: {settle_s: 0}
contacts: {law: unilateral}
"""
SWINGING = """\
duration_s: 0.1
plant:
  type: serial_arm
  chain: [{axis: y, length_m: 0.5, initial_deg: 89, limit_deg: [-90, 90]}]
metrics: {settle_s: 0}
"""
COLLIDING = """\
duration_s: 0.1
plant: {type: serial_arm, gravity_m_s2: [0, 0, 0], chain: [{length_m: 0.3}]}
objects:
  a: {mass_kg: 1, size_m: [0.1, 0.1, 0.1], position_m: [-0.3, 5, 0]}
  b: {mass_kg: 2, size_m: [0.1, 0.1, 0.1], position_m: [0, 5.01, 0.01]}
loads:
  push: {type: samples, body: a, times_s: [0, 0.01], force_N: [[300, 0, 0], [300, 0, 0]], interpolation: linear}
contacts: {law: unilateral, between: [{bodies: [a, b]}]}
integrator: {method: time_stepping}
metrics: {settle_s: 0}
"""

TABLES = [
    Overrides(
        "elbow_comparison",
        [
            ("settling time beyond the end", {"duration_s": 1, "metrics.settle_s": 3}),
            ("path that begins after the end", {"duration_s": 1, "controller.hand.path": LATE}),
            (
                "waypoints that begin after the end",
                {"duration_s": 1, "controller.joints": {"joint_2": {"times_s": [2, 3], "angles_deg": [45, 50]}}},
            ),
            ("load that begins after the end", {"duration_s": 1, "loads": {"push": PUSH}}),
            ("knots of references that do not move", {"controller": {"type": "joint_pd", "knot_spacing_s": 0.1}}),
            ("sampled loop that is unstable", {"controller.sample_time_s": 0.1}),
        ],
    ),
    Overrides(
        FLOOR,
        [
            ("tolerance of fixed steps", {"integrator": {"method": "time_stepping", "rtol": 1e-8}}),
            ("longest step of fixed steps", {"integrator": {"method": "time_stepping", "step_max_s": 1}}),
            ("tolerance of references on real contacts", {"contacts.reference_tolerance_m": 0.1}),
        ],
    ),
    Overrides(
        "single_pendulum",
        [
            ("friction without contacts", {"contacts": {"friction": 0.3}}),
            ("controller without motors", {"controller": {"type": "joint_pd", "k_p_V_per_rad": 9}}),
        ],
    ),
    Overrides("snake_circle", [("tolerance of a kinematic snake", {"integrator.rtol": 1e-8})]),
    Overrides("snake_positioning", [("dynamics of a kinematic snake", {"plant.dynamics.start": "released"})]),
    Edits(
        'dynsim.check(dynsim.load_scenario("arm.yaml"))',
        {"arm.yaml": HANGING},
        [
            ("bodies below a surface at the start", "duration_s: 0.1", "duration_s: 0.2"),
            (
                "candidates without surfaces",
                "surfaces: {floor: {type: plane}, thing: {type: plane, point_m: [0, 0, 0.55]}}",
                "",
                "law: unilateral",
                "law: unilateral, candidates: joints",
            ),
            (
                "surfaces on links only",
                "floor: {type: plane}, thing: {type: plane, point_m: [0, 0, 0.55]}",
                "lid: {type: plane, on: link_2}",
                "law: unilateral",
                "law: unilateral, candidates: links",
            ),
        ],
        keyed=False,
    ),
    Edits(
        'dynsim.simulate(dynsim.load_scenario("arm.yaml"))',
        {"arm.yaml": SWINGING},
        [
            ("joint that passes its limit", "duration_s: 0.1", "duration_s: 0.3"),
        ],
        keyed=False,
        measured=True,
    ),
    Edits(
        'dynsim.simulate(dynsim.load_scenario("arm.yaml"))',
        {"arm.yaml": COLLIDING},
        [
            ("bodies that pass through each other", "[[300, 0, 0], [300, 0, 0]]", "[[3000, 0, 0], [3000, 0, 0]]"),
            (
                "edges that are compressed beyond their rounding",
                "[0, 5.01, 0.01]",
                "[0, 5.03, 0.02], rpy_deg: [5, 0, 40]",
                "[a, b]",
                "[a, b], stiffness_N_per_m: 50000",
            ),
        ],
        keyed=False,
        measured=True,
    ),
    Overrides(
        "elbow_comparison",
        [
            ("floor that pulls on the elbows", {"duration_s": 1.5, "record.rate_hz": 20}),
            ("motors at their voltage limit", {"plant.link.motor.voltage_limit_V": 1.0}),
            ("motors with a nominal current", {"plant.link.motor.nominal_current_A": 0.01}),
            ("friction that reverses", {"contacts.friction": 0.9, "duration_s": 1.5, "record.rate_hz": 20}),
            ("controller that samples too slowly", {"controller.sample_time_s": 0.1, "duration_s": 1.0}),
        ],
        run=True,
        always=SHORT,
    ),
    Overrides(
        FLOOR,
        [
            ("brace in the air", {"surfaces.floor.point_m": [0, 0, -0.05]}),
            ("fixed steps that are too long", {"integrator": {"method": "time_stepping", "step_s": 0.02}}),
            (
                "reference beyond a stop",
                {
                    "plant.chain.1.limit_deg": [-95, 95],
                    "controller.joints": {"joint_3": {"times_s": [0, 0.05], "angles_deg": [90, 100]}},
                },
            ),
        ],
        run=True,
        always=SHORT,
    ),
    Overrides(
        "mobile_elbow_comparison_driving",
        [
            ("base that tips over", {"plant.base.caster_m": [0.02, 0, 0]}),
            ("wheels that would slip", {"plant.base.wheel_friction": 0.001}),
        ],
        run=True,
        always=SHORT,
    ),
    Overrides(
        "mobile_elbow_comparison_driving",
        [
            (
                "base that tips over and stops the run",
                {"plant.base.caster_m": [0.02, 0, 0], "plant.base.on_overturn": "stop"},
            )
        ],
        run=True,
        always=SHORT,
    ),
    Overrides(
        "block_on_slope",
        [("block that no friction holds", {"initial": {"equilibrium": True}}, "slides")],
        run=True,
        always=SHORT,
    ),
]
