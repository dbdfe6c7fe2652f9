"""Tables of hand paths with damaged cells, rows, text and bytes."""

from __future__ import annotations

from pathlib import Path
from random import Random

import numpy as np

from fuzz.case import Draft
from fuzz.mutations import mutate_bytes, mutate_text
from fuzz.readings import Unreadable, csv_rows

# The arm of elbow_comparison without elbows; its hand starts at (1.6, 1.5, 0.4).
SCENARIO = b"""\
name: path
duration_s: 0.3
plant:
  type: serial_arm
  base: {yaw_deg: 45}
  link: {mass_kg: 0.1, length_m: 0.3, radius_m: 0.01, damping_N_m_s_per_rad: 0.5, motor: {type: wang_minami}}
  chain: [{axis: z, length_m: 0.0}, {axis: y, count: 9}]
  initial_deg: [0, 45, 90, -90, 45, 45, -90, 45, -45, 45]
controller:
  type: joint_pd
  k_p_V_per_rad: 500
  k_d_V_s_per_rad: 20
  hand: {joints: [joint_1, joint_9, joint_10], path: {type: csv, file: path.csv}}
"""
CELLS = (
    "", " ", "0", "-1", "1e-3", "1e-320", "1e308", "1e999", "nan", "NaN", "inf", "-inf", "infinity", "1_0", "1_000.5",
    "１２", "٣", "²", "1,5", "1;5", "0x10", '"0.1"', "'0.1'", "1 2", "+1", ".5", "5.", "1e", "--1", "x", "#", "# x",
    "\x00", "\u00a01", "1\u200b", "\ufeff1", "1\x1c", "\x1f1", "9" * 400, "0." + "1" * 5000,
)  # fmt: skip


def draw(rng: Random, records: Path) -> Draft:
    turn = np.linspace(0.0, 1.0, rng.choice((2, 4, 12)))
    rows = [["t_s", "x_m", "y_m", "z_m"]] + [
        [f"{0.3 * s:.4f}", f"{1.5 + 0.1 * np.cos(s):.6f}", f"{1.5 + 0.1 * np.sin(s):.6f}", "0.4"] for s in turn
    ]
    separator, end = ",", "\n"
    whats = []
    for _ in range(rng.choice((1, 1, 1, 2))):
        row = rng.randrange(len(rows)) if rng.random() < 0.2 else rng.randrange(1, len(rows))
        kind = rng.choice(
            (
                "cell",
                "cell",
                "cell",
                "cell",
                "cell added",
                "cell removed",
                "row removed",
                "row doubled",
                "rows swapped",
                "separator",
                "end",
                "blank",
                "nothing",
            )
        )
        whats.append(f"{kind} (row {row})")
        if kind == "cell" and rows[row]:
            column = rng.randrange(len(rows[row]))
            rows[row][column] = rng.choice(CELLS)
            whats[-1] = f"row {row}, column {column} = {rows[row][column][:40]!r}"
        elif kind == "cell added":
            rows[row].append(rng.choice(CELLS))
        elif kind == "cell removed":
            del rows[row][-1:]
        elif kind == "row removed" and len(rows) > 2:
            del rows[row]
        elif kind == "row doubled":
            rows.insert(row, list(rows[row]))
        elif kind == "rows swapped":
            rows[row], rows[-1] = rows[-1], rows[row]
        elif kind == "separator":
            separator = rng.choice((";", "\t", " ", ", ", ",,"))
        elif kind == "end":
            end = rng.choice(("\r\n", "\r", "\n\n", "\x85", "\u2028", "\x0b", "\x0c", " # a comment\n"))
        elif kind == "blank":
            rows.insert(row, [rng.choice(("", " ", "# comment", "#", "\x0c", "\x00"))])
    data = (end.join(separator.join(row) for row in rows) + end).encode()
    if rng.random() < 0.35:
        data, mutation = mutate_bytes(rng, data) if rng.random() < 0.5 else mutate_text(rng, data.decode())
        whats.append(mutation)
    return Draft("; ".join(whats), {"scenario.yaml": SCENARIO, "path.csv": data}, [["check", "scenario.yaml"]], losses)


def losses() -> list[str]:
    """Return rows of path.csv that are not on the path."""
    from dynsim.scenario import load_scenario

    path = load_scenario("scenario.yaml").controller.hand.path
    try:
        rows = csv_rows(Path("path.csv").read_bytes())
    except Unreadable as error:
        return [f"a strict reading refuses the table: {str(error)[:80]!r}"]
    times = np.array([row[0] for row in rows])
    said, taken = np.array([row[1:] for row in rows]), path.position(times)
    beyond = path.position(np.array([times[0] - 1.0, times[-1] + 1.0]))
    lost = []
    with np.errstate(all="ignore"):
        if not np.allclose(said, taken, rtol=1e-9, atol=1e-12):
            lost.append("the path does not go through the rows")
        if not np.allclose(said[[0, -1]], beyond, rtol=1e-9, atol=1e-12):
            lost.append("the path does not begin and end with the table")
    return lost
