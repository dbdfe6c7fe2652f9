"""Height-field files with damaged cells, rows, text and bytes, under an arm that may touch them."""

from __future__ import annotations

from pathlib import Path
from random import Random

import numpy as np

from fuzz.case import Draft
from fuzz.inputs.csv_path import CELLS
from fuzz.mutations import mutate_bytes, mutate_text
from fuzz.readings import DECIMAL, Unreadable

SCENARIO = b"""\
name: terrain
duration_s: 0.02
metrics: {settle_s: 0}
plant:
  type: serial_arm
  base: {position_m: [0.45, 0.3, 0.5]}
  link: {mass_kg: 0.1, length_m: 0.1}
  chain: [{axis: y, count: 2, initial_deg: 60}]
surfaces: {ground: {type: height_field, file: heights.csv, spacing_m: [0.2, 0.2]}}
contacts: {law: unilateral, points: {tip: {body: link_2, surface: ground}}}
"""


def draw(rng: Random, records: Path) -> Draft:
    rows = [[f"{0.05 * np.sin(r) * np.cos(c):.4f}" for c in range(6)] for r in range(5)]
    whats = []
    for _ in range(rng.choice((1, 1, 2))):
        row = rng.randrange(len(rows))
        kind = rng.choice(("cell", "cell", "cell", "cell added", "cell removed", "row removed", "row doubled", "blank"))
        whats.append(f"{kind} (row {row})")
        if kind == "cell" and rows[row]:
            column = rng.randrange(len(rows[row]))
            rows[row][column] = rng.choice(CELLS)
            whats[-1] = f"row {row}, column {column} = {rows[row][column][:40]!r}"
        elif kind == "cell added":
            rows[row].append(rng.choice(CELLS))
        elif kind == "cell removed":
            del rows[row][-1:]
        elif kind == "row removed":
            del rows[row]
        elif kind == "row doubled":
            rows.insert(row, list(rows[row]))
        elif kind == "blank":
            rows.insert(row, [rng.choice(("", " ", "# comment", "#", "\x0c", "\x00"))])
    data = ("\n".join(",".join(row) for row in rows) + "\n").encode()
    if rng.random() < 0.35:
        data, mutation = mutate_bytes(rng, data) if rng.random() < 0.5 else mutate_text(rng, data.decode())
        whats.append(mutation)
    commands = [["check", "scenario.yaml"]]
    if rng.random() < 0.3:
        commands.append(["run", "scenario.yaml", "--out", "out", "--no-figures", "--quiet"])
    return Draft("; ".join(whats), {"scenario.yaml": SCENARIO, "heights.csv": data}, commands, losses)


def losses() -> list[str]:
    """Return heights of heights.csv that the surface lacks."""
    from dynsim.scenario import load_scenario

    taken = np.array(load_scenario("scenario.yaml").config.surfaces["ground"]._heights)
    try:
        lines = (
            Path("heights.csv").read_bytes().decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n").split("\n")
        )
    except UnicodeDecodeError as error:
        raise Unreadable("not UTF-8") from error
    said = []
    for line in lines:
        if line := line.partition("#")[0].strip(" \t"):
            cells = [cell.strip(" \t") for cell in line.split(",")]
            if not all(DECIMAL.fullmatch(cell) for cell in cells):
                return [f"a strict reading refuses the map: {line[:80]!r}"]
            said.append([float(cell) for cell in cells])
    if len({len(row) for row in said}) != 1:
        return ["a strict reading refuses the map: rows of different lengths"]
    return [] if np.array_equal(np.array(said), taken) else ["heights became others"]
