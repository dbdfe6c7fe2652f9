"""Comparison of two result folders, bit for bit: ``python .ci/same_numbers.py FIRST SECOND``.

Compares every signal of every record, and every summary except its wall times.
"""

from __future__ import annotations

import sys
from pathlib import Path

from dynsim.record import Record

TIMINGS = ("integration_wall_s", "real_time_factor")


def differences(first: Path, second: Path) -> list[str]:
    """Return the signals and keys of the summary in which two records differ."""
    a, b = Record.load(first), Record.load(second)
    unequal = [f"signals {sorted(set(a) ^ set(b))} are in one only"] if set(a) != set(b) else []
    if a.time.tobytes() != b.time.tobytes():
        unequal.append("time")
    unequal += [name for name in a if name in b and a[name].tobytes() != b[name].tobytes()]
    keys = (a.summary.keys() | b.summary.keys()) - set(TIMINGS)
    return unequal + [f"summary.{key}" for key in sorted(keys) if a.summary.get(key) != b.summary.get(key)]


def main(first: Path, second: Path) -> int:
    """Print the differences; return 1 if there are any, or if there is nothing to compare."""
    records = [path.relative_to(first) for path in sorted(first.rglob("record.h5"))]
    missing = {path.relative_to(second) for path in second.rglob("record.h5")} ^ set(records)
    unequal = {record: differences(first / record, second / record) for record in records if record not in missing}
    for record, names in unequal.items():
        print(f"{record}: {'differs in ' + ', '.join(names) if names else 'the same, bit for bit'}")
    for record in sorted(missing):
        print(f"{record}: in one folder only")
    return 0 if records and not missing and not any(unequal.values()) else 1


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
