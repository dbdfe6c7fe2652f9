"""Films, tables and viewer pages of shipped scenarios: ``python docs/site/gallery.py [--short] [SCENARIO…]``.

Writes to build/gallery/NAME, where the site finds them; existing results are kept. ``--short``: a still instead of a
film, of only the first second of the first variant, for checks.
"""

from __future__ import annotations

import io
import shutil
import sys
from pathlib import Path

import dynsim
from dynsim.cli.tables import print_comparison, print_summary
from dynsim.draw.film.film import Film
from dynsim.errors import RecordError, SimulationStopped
from dynsim.scenario import shipped_scenarios, variant_names
from dynsim.system.terminal import Terminal

BUILT = Path(__file__).parents[2] / "build" / "gallery"
VIEW, FILM, STILL, TABLE = "view.html", "film.gif", "still.png", "table.txt"
SIZE, FPS = (480, 300), 8
SHORT_S = 1.0
MOST = 6
"""Largest number of robots in one film."""


def build(name: str, short: bool) -> None:
    """Run all variants of a scenario, or only the first if ``short``; save its page, its table and a film."""
    folder = BUILT / name
    if (folder / TABLE).exists() and (short or (folder / FILM).exists()):
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    variants = variant_names(name)[: 1 if short else None] or [None]
    records = {variant or name: _run(name, variant, short) for variant in variants}
    text = io.StringIO()
    console = Terminal(file=text, width=110)
    summaries = {variant: record.summary for variant, record in records.items()}
    if len(records) > 1:
        print_comparison(console, summaries)
    else:
        print_summary(console, next(iter(summaries.values())))
    filmed = dict(list(records.items())[:MOST])
    try:
        film = Film(filmed, size=SIZE, fps=FPS, plot="")
        film.frame(float(film.times[len(film.times) // 2])).save(folder / STILL)
        if not short:
            dynsim.film.write(filmed, folder / FILM, size=SIZE, fps=FPS)
        dynsim.view.write(records, folder / VIEW)
    except RecordError as error:  # nothing to show, or a film that is too long
        print(f"{name}: {error}")
    (folder / TABLE).write_text(text.getvalue(), encoding="utf-8")


def _run(name: str, variant: str | None, short: bool) -> dynsim.Record:
    scenario = dynsim.load_scenario(name, variant)
    if short and scenario.duration_s > SHORT_S:
        scenario = dynsim.load_scenario(name, variant, {"duration_s": SHORT_S})
    try:
        return dynsim.simulate(scenario)
    except SimulationStopped as stop:  # as in a scenario that shows how a base tips over
        if stop.record is None:
            raise
        return stop.record


def page() -> str:
    """Return the page of the gallery, with the results built so far."""
    parts = [
        "# Gallery\n\nEvery shipped scenario, with the command that runs it. The tables have results of a run and the "
        "time of its integration, without the start of the program. `python docs/site/gallery.py` makes the films, "
        "tables and interactive pages before the site is built.\n"
    ]
    for file in shipped_scenarios():
        name = file.stem
        parts.append(f"\n## {name}\n\n{dynsim.load_scenario(name).config.description.strip()}\n")
        folder = BUILT / name
        picture = next((kind for kind in (FILM, STILL) if (folder / kind).exists()), None)
        if picture is not None:
            parts.append(f"\n![{name}](gallery/{name}/{picture})\n")
        if (folder / VIEW).exists():
            parts.append(f'\n<a href="gallery/{name}/{VIEW}">See it live</a>\n')
        if (folder / TABLE).exists():
            text = (folder / TABLE).read_text(encoding="utf-8").rstrip()
            parts.append(f'\n??? note "Table"\n\n    ```text\n{_indented(text)}\n    ```\n')
        command = "compare" if len(variant_names(name)) > 1 else "run"
        parts.append(f"\n```sh\ndynsim {command} {name}\n```\n")
    return "".join(parts)


def _indented(text: str) -> str:
    return "\n".join(f"    {line}" for line in text.splitlines())


def main() -> None:
    names = [name for name in sys.argv[1:] if name != "--short"]
    for name in names or [file.stem for file in shipped_scenarios()]:
        print(name, flush=True)
        build(name, short="--short" in sys.argv)


if __name__ == "__main__":
    main()
