"""Servo maps, fault scripts and gates."""

from studies.fault_table import MAP

from messages.case import ALL, Commands, Edits
from messages.stock import SWING

AREA = "Servo maps"
ORDER = 200

CHECK = "dynsim hw check swing.h5 --map rig.yaml"
REPLAY = "dynsim hw replay swing.h5 --map rig.yaml --port virtual --faults faults.yaml"
FAULTS = "faults:\n  - {kind: stuck, id: 2, at: 1.0}\n"

TABLES = [
    Edits(
        CHECK,
        {"rig.yaml": MAP, "swing.h5": SWING},
        [
            ("empty map", ALL, ""),
            ("list as map", ALL, "- 1\n"),
            ("map with brackets that do not close", "kinds:", "kinds: ["),
        ],
        keyed=False,
    ),
    Edits(
        CHECK,
        {"rig.yaml": MAP, "swing.h5": SWING},
        [
            ("misspelt key of a map", "robot: rig", "robott: rig"),
            ("robot with a slash in its name", "robot: rig", "robot: a/b"),
            ("map without servos", MAP[MAP.index("servos:") :], ""),
            ("ID twice", "id: 7", "id: 2"),
            ("ID out of range", "id: 1}", "id: 254}"),
            ("kind that does not exist", "kind: wheel, id: 7", "kind: whel, id: 7"),
            ("baud rate that servos do not have", "baud: 1000000", "baud: 1234"),
            ("rate of zero", "rate: 100", "rate: 0"),
            ("limits of a servo that are swapped", "[-60, 60]", "[60, -60]"),
            ("position servo without limits", "position_deg: [-60, 60], ", ""),
            ("true as sense", "sign: -1", "sign: true"),
            ("sense of 2", "sign: -1", "sign: 2"),
            ("negative velocity limit of a servo", "velocity: 3.0, torque", "velocity: -3.0, torque"),
            ("velocity that the servo does not reach", "velocity: 3.0", "velocity: 30.0"),
            ("torque that the servo does not have", "torque: 6.0", "torque: 60.0"),
            ("unknown model", "MX-106", "MX-105"),
            ("model with Protocol 1", "MX-106", "AX-12A"),
            ("unknown mode of a servo", "mode: velocity", "mode: current"),
            ("unknown policy", "policy: decelerate", "policy: panic"),
            ("misspelt limit", "torque: 6.0}", "torque: 6.0, torqe: 1}"),
            ("watchdog that is too slow", "run_up: 20", "run_up: 20, watchdog: 60"),
            ("stop that takes too long", "run_up: 20", "run_up: 20, stop_time: 60"),
            ("stop that is too short for its cycles", "run_up: 20", "stop_time: 0.02"),
            ("very fast approach", "run_up: 20", "approach_velocity: 50"),
            ("run-up that takes minutes", "run_up: 20", "run_up: 1.0e-12"),
            ("acceleration that no servo has", "torque: 6.0", "torque: 6.0, acceleration: 1.0e+30"),
            ("latency that no adapter has", "rate: 100", "rate: 100, latency: 1.0e-12"),
            ("rule that is slower than the watchdog", "run_up: 20", "missed_cycles: 20"),
            ("rule that takes too many cycles", "run_up: 20", "late_cycles: 51"),
            ("column twice", "id: 2, sign", "id: 2, label: shoulder, sign"),
            ("approach faster than a joint may move", "velocity: 3.0", "velocity: 0.2"),
            ("gear that makes a joint too slow", "error: 0.2", "error: 0.2\n    gear: 10"),
            ("zero tick beyond a turn", "zero_tick: 1900", "zero_tick: 9000"),
            ("supply with swapped limits", "{lowest: 10.5, highest: 14.0}", "{lowest: 14.0, highest: 10.5}"),
            (
                "lifts of joints that do not exist",
                "servos:",
                "lifts: {joints: [psi3], clearance_mm: 5, blend_s: 0.3}\nservos:",
            ),
            ("clearance of zero", "servos:", "lifts: {joints: [shoulder], clearance_mm: 0, blend_s: 0.3}\nservos:"),
        ],
    ),
    Edits(
        REPLAY,
        {"faults.yaml": FAULTS, "rig.yaml": MAP, "swing.h5": SWING},
        [
            ("unknown fault", "kind: stuck", "kind: stuk"),
            ("misspelt kind of a fault", "kind: stuck", "kid: stuck"),
            ("misspelt time of a fault", "at: 1.0", "att: 1.0"),
            ("fault of a servo that does not exist", "id: 2", "id: 44"),
            ("loss of the supply at no time", "{kind: stuck, id: 2, at: 1.0}", "{kind: supply_loss}"),
        ],
    ),
    Edits(
        "dynsim hw compare swing.h5 swing.h5 --gate gate.yaml",
        {"gate.yaml": "rms_rad: 0.1\n", "swing.h5": SWING},
        [
            ("misspelt bound of a gate", "rms_rad", "rms"),
            ("bound of zero", "0.1", "0"),
            ("empty gate", ALL, ""),
        ],
        keyed=False,
    ),
    Commands(
        [
            ("map that does not exist", "hw check swing.h5 --map nowhere.yaml"),
            ("folder as map", "hw check swing.h5 --map ."),
            ("faults for a real port", "hw replay swing.h5 --map rig.yaml --port /dev/ttyNone --faults faults.yaml"),
            ("port that does not exist", "hw scan --port /dev/ttyNone"),
            ("stop at a port that does not exist", "hw stop --port /dev/ttyNone"),
            ("replay at a port that does not exist", "hw replay swing.h5 --map rig.yaml --port /dev/ttyNone --out out"),
            ("replay into a file", "hw replay swing.h5 --map rig.yaml --port virtual --out rig.yaml"),
            ("calibration of a shipped map", "hw calibrate --map arm --port /dev/ttyNone"),
            (
                "calibration of a joint that does not exist",
                "hw calibrate --map rig.yaml --port /dev/ttyNone --joint knee",
            ),
            ("calibration with --live but without --nudge", "hw calibrate --map rig.yaml --port /dev/ttyNone --live"),
            (
                "drive with faults for a real port",
                "hw drive single_pendulum --map rig.yaml --port /dev/ttyNone --faults faults.yaml",
            ),
        ],
        {"swing.h5": SWING, "rig.yaml": MAP, "faults.yaml": FAULTS},
        named=False,
    ),
]
