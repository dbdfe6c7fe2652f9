"""Tables of a base path and of forces, with numbers that change a little and with damaged cells, rows and bytes."""

from __future__ import annotations

import copy
from pathlib import Path
from random import Random

from fuzz.case import SHIPPED, Draft
from fuzz.inputs.csv_path import CELLS
from fuzz.inputs.simulation import QUIET, tree_of
from fuzz.mutations import mutate_bytes, mutate_text, scaled, yaml_text
from fuzz.readings import DECIMAL, Unreadable, merged

TABLES = {"base_drive": ("mobile_turns", "recorded"), "lid_push": ("spring_drawer", "opens")}


def draw(rng: Random, records: Path) -> Draft:
    name = rng.choice([*TABLES])
    scenario, variant = TABLES[name]
    tree = copy.deepcopy(tree_of(scenario))
    variants = tree.pop("variants")
    tree = merged(tree, variants[variant] or {})
    text = yaml_text(tree).replace(f"data/{name}.csv", "table.csv")
    rows = [line.split(",") for line in (SHIPPED / "data" / f"{name}.csv").read_text(encoding="utf-8").splitlines()]
    done = []
    for _ in range(rng.choice((1, 2, 3))):
        row = rng.randrange(1, len(rows))
        column = rng.randrange(len(rows[row]))
        choice = rng.random()
        if choice < 0.6 and DECIMAL.fullmatch(rows[row][column]):
            rows[row][column] = str(scaled(rng, float(rows[row][column])))
        elif choice < 0.75:
            rows[row][column] = rng.choice(CELLS)
        elif choice < 0.85 and len(rows) > 3:
            del rows[row]
        elif choice < 0.95:
            rows.insert(row, rng.choice((list(rows[row]), ["# comment"], [""])))
        done.append(f"row {row}, column {column}")
    data = ("\n".join(",".join(row) for row in rows) + "\n").encode()
    if rng.random() < 0.25:
        data, mutation = mutate_bytes(rng, data) if rng.random() < 0.5 else mutate_text(rng, data.decode())
        done.append(mutation)
    command = ["run", "scenario.yaml", *QUIET, "--out", "out"] if rng.random() < 0.6 else ["check", "scenario.yaml"]
    return Draft(f"{name}: {'; '.join(done)}", {"scenario.yaml": text.encode(), "table.csv": data}, [command], losses)


def losses() -> list[str]:
    """Return a cell of an accepted table that is not a decimal number."""
    from dynsim.scenario import load_scenario

    load_scenario("scenario.yaml")
    try:
        text = Path("table.csv").read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise Unreadable("not UTF-8") from error
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")[1:]
    rows = filter(None, (line.partition("#")[0].strip(" \t") for line in lines))
    cells = [cell.strip(" \t") for row in rows for cell in row.split(",")]
    strange = [cell for cell in cells if not DECIMAL.fullmatch(cell)]
    return [f"a strict reading refuses the cell {strange[0][:40]!r}"] if strange else []
