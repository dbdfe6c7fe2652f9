"""Recorded positions with damaged cells, rows, text and bytes, imported with a servo map."""

from __future__ import annotations

from pathlib import Path
from random import Random

import numpy as np
from studies.fault_table import MAP

from fuzz.case import Draft
from fuzz.inputs.csv_path import CELLS
from fuzz.mutations import mutate_bytes, mutate_text
from fuzz.readings import Unreadable, csv_rows

HEADINGS = ("t", "timestamp_ms", "time [h]", "shoulder", "shoulder.pos [deg]", "elbow [tick]", "", "[rad]", "a,b", '"')
# The limit of the import, and the change of the motion within half a sample.
NEAR = 0.05 + 0.02


def draw(rng: Random, records: Path) -> Draft:
    times = np.arange(rng.choice((3, 60, 60, 60))) / 30
    header = ["time [s]", "shoulder [rad]", "elbow [rad]", "wheel [rad]"]
    rows = [[f"{t:.4f}", f"{0.3 * np.sin(t):.5f}", f"{0.2 * np.cos(t):.5f}", f"{t:.5f}"] for t in times]
    whats = []
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        row, column = rng.randrange(len(rows)), rng.randrange(4)
        kind = rng.choice(("cell", "cell", "cell", "heading", "rows removed", "row doubled", "rows swapped", "shift"))
        whats.append(f"{kind} (row {row}, column {column})")
        if kind == "cell":
            rows[row][column] = rng.choice(CELLS)
        elif kind == "heading":
            header[column] = rng.choice(HEADINGS)
        elif kind == "rows removed" and len(rows) > 10:
            del rows[row : row + rng.choice((1, 2, 4, 30))]
        elif kind == "row doubled":
            rows.insert(row, list(rows[row]))
        elif kind == "rows swapped":
            rows[row], rows[-1] = rows[-1], rows[row]
        elif kind == "shift":
            rows[row] = [rows[row][0], *("0.7" for _ in rows[row][1:])]
    data = "\n".join(",".join(row) for row in [header, *rows]).encode()
    if rng.random() < 0.2:
        data, mutation = mutate_bytes(rng, data) if rng.random() < 0.5 else mutate_text(rng, data.decode())
        whats.append(mutation)
    command = ["import", "recording.csv", "--map", "map.yaml", *rng.choice(([], [], ["--unit", "deg"]))]
    files: dict[str, bytes | str] = {"recording.csv": data, "map.yaml": MAP.encode()}
    return Draft("; ".join(whats), files, [command, ["hw", "check", "recording.h5", "--map", "map.yaml"]], losses)


def losses() -> list[str]:
    """Return samples, except reported outliers, from which the imported motion is too far."""
    from dynsim.hardware.imported import import_motion
    from dynsim.hardware.servo_map import load_servo_map

    path = Path("recording.csv")
    record, joints, _ = import_motion(path, load_servo_map("map.yaml"))
    if not path.read_bytes().startswith(b"time [s],shoulder [rad],elbow [rad],wheel [rad]\n"):
        return []
    try:
        rows = np.array(csv_rows(path.read_bytes()))
    except Unreadable:
        return []  # an empty cell or "nan", which are samples that are missing
    lost = []
    for joint, column, name in zip(joints, rows.T[1:], ("q", "q", "rho"), strict=True):
        data = record[name][:, record.labels[name].index(joint.joint)]
        far = np.abs(np.interp(rows[:, 0] - rows[0, 0], record.time, data) - column) > NEAR
        if far.sum() > len(joint.outliers):
            lost.append(f"{far.sum()} samples of {joint.joint} are far from the motion")
    return lost
