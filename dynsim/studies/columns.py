"""Columns of a table of runs: flat numbers of a summary, kinds of values, CSV text."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

# Excluded: names, which have columns of their own, and computing times, which are not reproducible.
_NOT_OF_THE_RUN = ("scenario", "variant", "dynsim_version", "integration_wall_s", "real_time_factor")


def flat(summary: dict[str, Any]) -> dict[str, Any]:
    """A summary whose numbers of a mobile base and of motors stand beside the others, as ``base.…`` and ``JOINT.…``."""
    base = dict(summary.get("base", {}))
    for key in [key for key, value in base.items() if isinstance(value, dict)]:
        base.update({f"{key}.{name}": value for name, value in base.pop(key).items()})
    motors = {
        f"{motor['joint']}.{key}": value
        for motor in summary.get("motors", ())
        for key, value in motor.items()
        if key != "joint"
    }
    return summary | {f"base.{key}": value for key, value in base.items()} | motors


def is_text(value: Any) -> bool:
    """True for a text, which has no place in a column of numbers."""
    return isinstance(value, str)


def is_scalar(value: Any) -> bool:
    """True for a number, a text or nothing."""
    return value is None or isinstance(value, (int, float, str))


def is_finite(value: Any) -> bool:
    """True for a finite number of double precision."""
    return isinstance(value, (int, float)) and abs(value) <= sys.float_info.max


def numbers(summary: dict[str, Any]) -> dict[str, Any]:
    """All finite numbers of a summary that do not depend on the machine; those of contacts under ``CONTACT.…``."""
    values = flat(summary)
    for key, value in summary.items():
        if isinstance(value, dict) and key != "base":
            values |= {f"{key}.{name}": entry for name, entry in value.items()}
    for contact in summary.get("contacts", ()):
        values |= {f"{contact['name']}.{key}": value for key, value in contact.items()}
    return {key: value for key, value in values.items() if is_finite(value) and key not in _NOT_OF_THE_RUN}


def csv_table(names: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """CSV of rows by column: all digits, an empty field for nothing."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()
