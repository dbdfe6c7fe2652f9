"""Command lines of run, check and teleop, and obstacles to their output."""

from messages.case import Commands

AREA = "Command line"
ORDER = 90

SHORT = "--set duration_s=0.05 --set metrics.settle_s=0 --no-figures"
HALF = """\
duration_s: 1
plant: {type: serial_arm, chain: [{axis: y, mass_kg: heavy}]}
"""
TWO = """\
duration_s: 1
plant: {type: serial_arm, chain: [{axis: y}]}
variants:
  light: {}
  heavy: {plant: {link: {mass: 3}}}
"""

TABLES = [
    Commands(
        [
            ("run of a file that does not exist", "run nonsense.yaml"),
            ("run of a folder", "run ."),
            ("run of a variant that does not exist", "run elbow_comparison --variant elbow_5"),
            ("variant of a scenario without variants", "run single_pendulum --variant light"),
            ("setting without a value", "run elbow_comparison --set integrator.rtol"),
            ("setting that is not valid", "run elbow_comparison --set plant.link.mass_kg=-1"),
            ("record that would be too large", "run elbow_comparison --set record.rate_hz=1e7"),
            ("run into a file", f"run single_pendulum {SHORT} --out case.yaml"),
            ("run below a file", f"run single_pendulum {SHORT} --out case.yaml/run"),
            ("run into a folder that has a folder called summary.json", f"run single_pendulum {SHORT} --out taken"),
            ("run of a file with a mistake", "run case.yaml"),
            ("check of a file with a mistake", "check case.yaml"),
            ("check of a file with a mistake in its second variant", "check two.yaml"),
            ("check of several scenarios with mistakes", "check case.yaml two.yaml single_pendulum"),
            ("check of a misspelt key", "check elbow_comparison --set duraton_s=1"),
            ("check of a path out of reach", "check elbow_comparison --set controller.hand.path.radius_m=0.6"),
            ("check of a valid scenario", "check single_pendulum"),
            ("drive of a scenario without a controller", "teleop single_pendulum --no-open"),
            (
                "drive of an arm whose hand nothing moves",
                "teleop elbow_comparison --no-open --set controller.hand=null",
            ),
            ("posture of a file that does not exist", "pose nonsense.yaml --no-open"),
            ("posture of a file with a mistake", "pose case.yaml --no-open"),
            ("posture of a variant that does not exist", "pose two.yaml --variant medium --no-open"),
            ("drive into a file", "teleop elbow_comparison --no-open --out case.yaml"),
            (
                "run that makes no progress",
                "run single_pendulum --no-figures --set integrator.step_max_s=1e-9 --set integrator.method=dopri5",
            ),
        ],
        {"case.yaml": HALF, "two.yaml": TWO, "taken/summary.json/file": ""},
    ),
]
