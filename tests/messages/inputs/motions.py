"""Motions for servos: the check of a record, replays on virtual servos, comparisons, and records that are recovered."""

from studies.fault_table import CASES, MAP, Case

from messages.case import Calls, Commands
from messages.stock import SWING

AREA = "Motion of servos"
ORDER = 210

# After the first torque enable: the rig moves to its start, then along the record [s].
ONSETS = {"stuck": 0.4, "overheat": 0.7, "voltage_sag": 0.7}


# Faults with the message of `lost_status, for good`.
SAME = {"late_status", "truncated_status", "bad_crc", "drop_off"}


def entry(case: Case) -> dict[str, object]:
    """Return the fault of a case for its first servo; a fault that exists from the beginning has no time."""
    servo = {"id": case.ids[0]} if case.ids else {}
    onset = {"at": ONSETS.get(case.name, 0.9)} if case.scripted_onset else {}
    return case.entry | servo | onset


TABLES = [
    Calls(
        [
            ("motion beyond a limit", "motion('record.signals[\"q\"].data[:] *= 3')"),
            ("rates beyond a limit", "motion('record.signals[\"v\"].data[:] *= 3')"),
            ("angle that is not a number", "motion('record[\"q\"][3, 1] = math.nan')"),
            ("missing rates", "motion('del record.signals[\"v\"]')"),
            ("missing column", 'motion(\'record.add("q", record["q"], "rad", labels=("shoulder", "knee"))\')'),
            ("misspelt column", 'motion(\'record.add("q", record["q"], "rad", labels=("shoulder", "elbw"))\')'),
            ("angles in degrees", 'motion(\'record.add("q", record["q"], "deg", labels=("shoulder", "elbow"))\')'),
            ("time twice", "motion('record.time[4] = 0.0')"),
            ("time that ends at infinity", "motion('record.time[-1] = math.inf')"),
            ("time with a hole of samples", "motion('record.time[100:] += 0.2')"),
            ("time in the wrong unit", "motion('record.time[:] *= 1e8')"),
            ("motion with a spike", "motion('record[\"q\"][100, 0] += 0.02')"),
            ("motion with a limit of acceleration", "motion('', 'torque: 6.0', 'torque: 6.0, acceleration: 3')"),
            ("motion with a limit of jerk", "motion('', 'torque: 6.0', 'torque: 6.0, jerk: 3')"),
            ("speed of zero", "motion('', speed=0.0)"),
            ("speed of eleven", "motion('', speed=11.0)"),
            ("speed at which a joint is too fast", "motion('', speed=1.5)"),
            ("rate of the replay of zero", "motion('', rate=0.0)"),
            ("rate that the bus does not carry", "motion('', rate=2000)"),
            ("rate at which watchdogs would trip", "motion('', rate=14)"),
            ("record that is marked incomplete", "motion('record.complete = False')"),
        ],
        heading="check of a motion",
    ),
    Calls(
        [
            (
                "outlier, repeated row, short gap",
                "imported('rows[9][1] = \"2\"; rows[20] = rows[19]; del rows[50:52]')",
            ),
            ("one column without a unit", "imported('', header='time [s],shoulder [rad],elbow [rad],wheel')"),
            ("column without a unit", "imported('', header='time [s],shoulder,elbow,wheel')"),
            ("column that is missing", "imported('', header='time [s],shoulder [rad],elbw [rad],wheel [rad]')"),
            ("column that occurs twice", "imported('', header='time [s],elbow [rad],elbow [rad],wheel [rad]')"),
            ("table without a time", "imported('', header='a,shoulder [rad],elbow [rad],wheel [rad]')"),
            ("unit of time that is unknown", "imported('', header='time [h],shoulder [rad],elbow [rad],wheel [rad]')"),
            ("time in milliseconds", "imported('', header='time [ms],shoulder [rad],elbow [rad],wheel [rad]')"),
            ("row with a value too few", "imported('del rows[7][3]')"),
            ("value that is not a number", "imported('rows[7][1] = \"0.1.2\"')"),
            ("row without a time", "imported('rows[7][0] = \"\"')"),
            ("time that decreases", "imported('rows[7][0] = \"0.1\"')"),
            ("two positions at one time", "imported('rows[7][0] = rows[6][0]')"),
            ("long gap", "imported('del rows[50:70]')"),
            ("jump of a joint", "imported('for row in rows[60:]: row[1] = str(float(row[1]) + 1)')"),
            ("many outliers", "imported('for row in rows[3::9]: row[1] = \"3\"')"),
            ("few samples", "imported('del rows[5:]')"),
            ("bandwidth beyond the samples", "imported('', bandwidth=20.0)"),
            ("bandwidth of zero", "imported('', bandwidth=0.0)"),
            ("topic of a table", "imported('', topic='/joint_states')"),
        ],
        heading="import of a recording",
    ),
    Calls(
        [(case.name, f"replayed({entry(case)})") for case in CASES if case.causes and case.name not in SAME],
        heading="faults of virtual servos",
        measured=True,
    ),
    Calls(
        [
            ("state of two columns", 'compared(\'measured.add("state", np.zeros((240, 2)), "1", labels=("a", "b"))\')'),
            ("speed that is a text", 'compared(\'measured.provenance["speed"] = "fast"\')'),
            ("speed of zero in the provenance", "compared('measured.provenance[\"speed\"] = 0')"),
            ("lifts that are a number", 'compared(\'measured.provenance["lifts"] = {"joints": 3}\')'),
            ("measured run of another time", "compared('measured.time[:] += 100')"),
            ("measured run of other joints", "compared('measured.signals = {}')"),
        ],
        heading="comparison with a measured run",
    ),
    Commands(
        [
            ("recovery of a folder without a stream", "hw recover ."),
            ("recovery of an empty stream", "hw recover empty"),
            ("recovery of a stream of another program", "hw recover other"),
            ("recovery of a folder that does not exist", "hw recover nowhere"),
            ("measured run whose replay died", "plot empty/measured.h5"),
            ("comparison of a joint that does not exist", "hw compare swing.h5 swing.h5 --joint knee"),
            ("comparison with a file that is not a record", "hw compare swing.h5 rig.yaml"),
            ("import of a file of another type", "import rig.yaml --map rig.yaml"),
            ("import of a file that does not exist", "import nowhere.csv --map rig.yaml"),
            ("import over the recording", "import swing.h5 --map rig.yaml"),
            ("import of a damaged bag", "import bag.mcap --map rig.yaml"),
            ("check of a file that is not a record", "hw check rig.yaml --map rig.yaml"),
            ("check of a record that does not exist", "hw check nowhere.h5 --map rig.yaml"),
            ("check of a record of another robot", "hw check swing.h5 --map arm"),
        ],
        {
            "swing.h5": SWING,
            "rig.yaml": MAP,
            "bag.mcap": "bag",
            "empty/measured.part": "",
            "other/measured.part": "{}\n",
        },
        named=False,
    ),
]
