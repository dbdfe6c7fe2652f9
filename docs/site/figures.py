"""Catalogue of figures: every figure that dynsim draws, from runs of shipped scenarios, with its description.

Pictures are in build/figures, and are kept until the sources of dynsim or the scenarios change.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import gallery

import dynsim
from dynsim.draw.figures import _module, measured, plan, sweep
from dynsim.errors import RecordError
from dynsim.scenario import variant_names

BUILT = gallery.ROOT / "build" / "figures"
INDEX = "index.json"
DPI = 100
INTRODUCTION = """# Figures

Every figure that dynsim draws. `dynsim run`, `compare`, `sweep`, `plan` and `hw replay` write them to the folder of
their results, and `dynsim plot RECORD` draws those of records again, as PNG, PDF or SVG. In Python,
`dynsim.figure(record, NAME)` returns such a figure, and `dynsim.figure({"a": record_a, "b": record_b}, NAME)` returns
a figure that compares records; [Figures for a paper](../how-to/figures.md) has examples. [T] is the paper about the
[snake](../snake.md).

"""
# Sections with figures of records: title, records that have the figures, scenario, and variants (None: all).
Variants = tuple[str, ...] | None
SECTIONS: tuple[tuple[str, str, str, Variants], ...] = (
    ("Run of an arm", "Records of arms, fixed or on a mobile base.", "elbow_comparison_floor", ("two_elbows",)),
    (
        "Run of an arm on a mobile base",
        "In addition to the figures of an arm.",
        "mobile_elbow_comparison",
        ("elbow_7",),
    ),
    ("Several runs of an arm", "Several records of arms.", "elbow_comparison_floor", None),
    ("Several runs of mobile bases", "In addition to the figures of several arms.", "mobile_elbow_comparison", None),
    ("Run of a snake", "Records of the snake.", "snake_circle", ("backward_switching",)),
    ("Run of a dynamic snake", "Records of a snake with bodies, servos and objects.", "snake_pick_up", ("lifts",)),
    ("Several runs of a snake", "Several records of the snake.", "snake_circle", None),
    ("Positions of the head, as in [T]", "All variants, or some.", "snake_positioning", None),
    (
        "Positions of the head of the dynamic snake, as in [T]",
        "All variants, or some.",
        "snake_positioning_dynamic",
        ("x", "x_kinematic", "x_measured", "beta", "beta_kinematic", "beta_measured"),
    ),
    ("Joint limits, as in [T]", "All variants.", "snake_joint_limits", None),
    ("Door, as in [T]", "Variant `pull_switching`.", "snake_door_arc", ("pull", "pull_switching")),
)
SWEEP = "sweep elbow_comparison_floor --variants elbow_7,elbow_4 --set duration_s=2 --set metrics.settle_s=0.5"
# Sections with figures of commands, in the folder "figures": title, records that have the figures, and commands.
COMMANDS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    (
        "Measured run",
        "Records of `dynsim hw replay`, and their comparison with the simulated record.",
        (
            "run elbow_comparison --variant two_elbows --set duration_s=3 --no-figures --out run",
            "hw replay run/record.h5 --map arm --port virtual --out figures",
            "plot figures/measured.h5 --out figures",
            "hw compare run/record.h5 figures/measured.h5",
        ),
    ),
    ("Sweep over a key", "Sweeps.", (f"{SWEEP} --grid contacts.friction=0:0.5:6 --out figures",)),
    (
        "Sweep over two keys",
        "Sweeps with two grids.",
        (f"{SWEEP} --grid contacts.friction=0:0.5:4 --grid plant.link.mass_kg=0.08:0.12:4 --out figures",),
    ),
    (
        "Sweep over samples",
        "Sweeps with samples.",
        (
            f'{SWEEP} --sample "contacts.friction=uniform(0.05,0.3)" --sample "plant.link.mass_kg=normal(0.1,0.005)" '
            "--count 60 --out figures",
        ),
    ),
    ("Plan of braces", "Plans.", ("plan pressing --count 0:2 --candidates link_4:link_8 --starts 2 --out .",)),
    (
        "Plans for several values",
        "Plans with `--vary`.",
        (
            "plan bench_arm --candidates pad --count 0:1 --no-verify --vary contacts.points.pad.point_m.2=0.1:0.3:3 "
            "--out .",
        ),
    ),
)


def build() -> list[dict[str, Any]]:
    """Return the sections of the catalogue; draw their figures if they are not there."""
    if (BUILT / INDEX).exists():
        return list(json.loads((BUILT / INDEX).read_text(encoding="utf-8")))
    shutil.rmtree(BUILT, ignore_errors=True)
    BUILT.mkdir(parents=True)
    sections, seen = [], set[tuple[str, str]]()
    for title, records, commands, drawn in (*map(_of_records, SECTIONS), *map(_of_commands, COMMANDS)):
        print(f"figures: {title}", flush=True)
        entries = []
        for name, text, save in drawn:
            if (name, text) not in seen:
                seen.add((name, text))
                file = f"{len(seen):02}_{name}.png"
                save(BUILT / file)
                entries.append({"name": name, "text": text, "file": file})
        sections.append({"title": title, "records": records, "commands": commands, "figures": entries})
    (BUILT / INDEX).write_text(json.dumps(sections), encoding="utf-8")
    return sections


Drawn = Iterator[tuple[str, str, Callable[[Path], Any]]]


def _of_records(section: tuple[str, str, str, Variants]) -> tuple[str, str, list[str], Drawn]:
    title, whose, scenario, variants = section
    single = variants is not None and len(variants) == 1
    command = f"run {scenario} --variant {variants[0]}" if variants and single else f"compare {scenario}"

    def drawn() -> Drawn:
        records = {variant: gallery.run(scenario, variant) for variant in variants or variant_names(scenario)}
        shown = next(iter(records.values())) if single else records
        module = _module(next(iter(records.values())))
        makers: Mapping[str, Any] = module.figures(shown) if single else module.comparisons(shown)
        for name, make in makers.items():
            try:
                figure = dynsim.figure(shown, name)
            except RecordError as error:
                if "has no data" not in str(error):
                    raise
                continue
            text = described(make.__doc__) or described(figure.get_suptitle().partition(": ")[2])
            yield name, text, lambda file, figure=figure: figure.savefig(file, dpi=DPI)

    return title, whose, [command], drawn()


def _of_commands(section: tuple[str, str, tuple[str, ...]]) -> tuple[str, str, list[str], Drawn]:
    title, whose, commands = section
    texts = {
        name: described(make.__doc__) for module in (measured, plan, sweep) for name, make in module.FIGURES.items()
    }
    texts["comparison"] = described(measured.draw_errors.__doc__)

    def drawn() -> Drawn:
        with tempfile.TemporaryDirectory() as folder:
            for command in commands:
                words = [sys.executable, "-m", "dynsim", *shlex.split(command)]
                path = os.pathsep.join(filter(None, [str(gallery.ROOT), os.environ.get("PYTHONPATH")]))
                done = subprocess.run(
                    words,
                    cwd=folder,
                    env={**os.environ, "PYTHONPATH": path},
                    capture_output=True,
                    text=True,
                    check=False,
                )
                if done.returncode:
                    raise RuntimeError(f"dynsim {command}: {done.stderr}")
            for file in sorted(Path(folder, "figures").glob("*.png"), key=lambda file: list(texts).index(file.stem)):
                yield file.stem, texts[file.stem], lambda target, file=file: shutil.copy(file, target)

    return title, whose, list(commands), drawn()


def described(docstring: str | None) -> str:
    """Return the first line of a docstring as a description: "Draw A of B; return None without C" becomes sentences."""
    line = (docstring or "").strip().partition("\n")[0].rstrip(".")
    shows, _, omitted = line.removeprefix("Draw ").removeprefix("Overlay ").partition("; return None ")
    text = f"{shows[:1].upper()}{shows[1:]}." if shows else ""
    return f"{text} Omitted {omitted}." if omitted else text


def page() -> str:
    """Return the catalogue of figures; draw the figures that are missing."""
    gallery.clean()
    parts = [INTRODUCTION]
    for section in build():
        commands = "\n".join(f"dynsim {command}" for command in section["commands"])
        parts.append(f"\n## {section['title']}\n\n{section['records']}\n\n```sh\n{commands}\n```\n")
        for figure in section["figures"]:
            name, text = figure["name"], figure["text"]
            parts.append(f"\n### `{name}`\n\n{text}\n\n![{name}](../figures/{figure['file']})\n")
    return "".join(parts)


if __name__ == "__main__":
    page()
