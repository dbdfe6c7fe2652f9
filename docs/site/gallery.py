"""Stills, films, tables and viewer pages of shipped scenarios: ``python docs/site/gallery.py [SCENARIO…]``.

The site makes a still of every scenario itself. This command adds a film, a page in 3D and a table of all variants.
Results are in build/gallery/NAME, and are kept until the sources of dynsim or the scenarios change. With ``--sheet``
the command only draws docs/images/scenarios.png, the stills of all scenarios in one picture.
"""

from __future__ import annotations

import hashlib
import io
import shutil
import sys
import warnings
from functools import cache
from pathlib import Path

from PIL import Image, ImageDraw
from PIL.PngImagePlugin import PngInfo

import dynsim
from dynsim.cli.comparison import print_comparison, print_summary
from dynsim.draw.film.film import HEAD, Film
from dynsim.draw.film.painter import font
from dynsim.errors import RecordError, SimulationStopped
from dynsim.scenario import shipped_scenarios, variant_names
from dynsim.system.terminal import Terminal

ROOT = Path(__file__).parents[2]
BUILT = ROOT / "build" / "gallery"
VIEW, FILM, STILL, TABLE, ALL = "view.html", "film.gif", "still.png", "table.txt", "all.txt"
SIZE, FPS = (480, 300), 8
MOST = 6
"""Largest number of robots in one film."""
COLUMNS = 4
"""Number of stills in a row of the picture of all scenarios."""
SHOTS: dict[str, tuple[str | None, str, float]] = {
    "block_on_slope": ("slides", "iso", 0.5),
    "bouncing_link": ("lively", "side", 0.25),
    "box_on_brace": ("heavy", "side", 0.5),
    "brace_on_itself": ("braced", "iso", 0.5),
    "brace_on_shapes": ("terrain", "iso", 0.5),
    "elbow_comparison_floor": ("elbow_7", "side", 0.6),
    "elbow_comparison_links": ("soft", "side", 0.5),
    "elbow_comparison_vertical": ("two_elbows", "side", 0.7),
    "falling_arm": (None, "side", 0.2),
    "floor_below": ("lands", "side", 0.5),
    "free_flyer": ("cycle", "iso", 0.35),
    "hand_over": (None, "side", 0.5),
    "mobile_path": (None, "iso", 0.8),
    "mobile_reach": (None, "side", 1.0),
    "mobile_turns": ("fast_arc", "iso", 0.9),
    "pressing": ("optimal", "side", 0.5),
    "push_box": ("pushes", "iso", 0.5),
    "single_pendulum": (None, "side", 0.5),
    "snake_circle": ("forward", "iso", 0.35),
    "snake_circle_backward": (None, "top", 0.9),
    "snake_door": ("push", "iso", 0.85),
    "snake_door_arc": ("pull_switching", "top", 0.6),
    "snake_joint_limits": ("eq20", "top", 0.5),
    "snake_pick_up": ("lifts", "iso", 0.75),
    "snake_push": ("i_x", "iso", 0.8),
    "snake_short": ("rises", "side", 0.6),
    "snake_valve": ("turns", "iso", 0.6),
    "soft_floor": ("foam", "side", 0.5),
    "tall_path": (None, "side", 0.5),
    "wall_push": ("strong_hold", "side", 0.5),
}
"""Variant, view, and time relative to the duration of stills; default: the first variant, iso, 0.5."""


def clean() -> None:
    """Delete what other sources of dynsim have made."""
    digest = hashlib.sha256()
    for folder in ("dynsim", "scenarios", "docs/site"):
        for file in sorted(
            path for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".yaml", ".csv", ".urdf")
        ):
            digest.update(file.read_bytes())
    made_by = ROOT / "build" / "sources.txt"
    if not made_by.exists() or made_by.read_text(encoding="utf-8") != digest.hexdigest():
        for folder in ("gallery", "figures", "notebooks"):
            shutil.rmtree(ROOT / "build" / folder, ignore_errors=True)
        made_by.parent.mkdir(exist_ok=True)
        made_by.write_text(digest.hexdigest(), encoding="utf-8")


@cache
def run(name: str, variant: str | None) -> dynsim.Record:
    """Return the record of a run, which ends early if the run stops."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return dynsim.simulate(dynsim.load_scenario(name, variant))
        except SimulationStopped as stop:
            if stop.record is None:
                raise
            return stop.record


def still(name: str) -> None:
    """Save a picture of one variant of a scenario, and its summary."""
    folder = BUILT / name
    if (folder / STILL).exists():
        return
    print(f"still of {name}", flush=True)
    first = next(iter(variant_names(name)), None)
    variant, view, share = SHOTS.get(name, (first, "iso", 0.5))
    record = run(name, variant)
    film = Film({variant or name: record}, view=view, size=SIZE, plot="")
    folder.mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    print_summary(Terminal(file=text, width=110), record.summary)
    (folder / TABLE).write_text(text.getvalue(), encoding="utf-8")
    film.frame(float(record.time[0] + share * (record.time[-1] - record.time[0]))).save(folder / STILL, optimize=True)


def build(name: str) -> None:
    """Run all variants of a scenario; save a film, a page, and a table."""
    still(name)
    folder = BUILT / name
    if (folder / ALL).exists():
        return
    print(f"film of {name}", flush=True)
    records = {variant or name: run(name, variant) for variant in variant_names(name) or [None]}
    filmed = dict(list(records.items())[:MOST])
    try:
        dynsim.film.write(filmed, folder / FILM, size=SIZE, fps=FPS)
    except RecordError as error:  # a film that is too long
        print(f"{name}: {error}")
    dynsim.view.write(records, folder / VIEW)
    text = io.StringIO()
    if len(records) > 1:
        print_comparison(Terminal(file=text, width=110), {name: record.summary for name, record in records.items()})
    (folder / ALL).write_text(text.getvalue(), encoding="utf-8")


def page() -> str:
    """Return the page of the gallery; make the stills that are missing."""
    clean()
    parts = [
        "# Gallery\n\nEvery shipped scenario, with the command that runs it. A summary contains the time of the "
        "integration, without the start of the program. `python docs/site/gallery.py` adds films, comparisons and "
        "interactive pages before the site is built.\n"
    ]
    names = [file.stem for file in shipped_scenarios()]
    for name in names:
        still(name)
    tiles = [f'<a href="#{name}"><img src="gallery/{name}/{STILL}" alt="">{name}</a>' for name in names]
    parts.append('\n<div class="tiles">' + "".join(tiles) + "</div>\n")
    for name in names:
        parts.append(f"\n## {name}\n\n{dynsim.load_scenario(name).config.description.strip()}\n")
        folder = BUILT / name
        picture = FILM if (folder / FILM).exists() else STILL
        parts.append(f"\n![{name}](gallery/{name}/{picture})\n")
        if (folder / VIEW).exists():
            parts.append(f'\n<a href="gallery/{name}/{VIEW}">See it live</a>\n')
        several = len(variant_names(name)) > 1
        for file, title in ((TABLE, "Summary of the run in the picture"), (ALL, "Comparison of all variants")):
            text = (folder / file).read_text(encoding="utf-8").rstrip() if (folder / file).exists() else ""
            if text:
                parts.append(f'\n??? note "{title}"\n\n    ```text\n{_indented(text)}\n    ```\n')
        parts.append(f"\n```sh\ndynsim {'compare' if several else 'run'} {name}\n```\n")
    return "".join(parts)


def _indented(text: str) -> str:
    return "\n".join(f"    {line}" for line in text.splitlines())


def sheet() -> None:
    """Save the stills of all scenarios in one picture, with their names, for readers of a checkout."""
    names = [file.stem for file in shipped_scenarios()]
    width, height = SIZE[0] // 2, SIZE[1] // 2 + 6
    image = Image.new("RGB", (COLUMNS * width, -(-len(names) // COLUMNS) * height), "#FFFFFF")
    for k, name in enumerate(names):
        still(name)
        x, y = k % COLUMNS * width, k // COLUMNS * height
        with Image.open(BUILT / name / STILL) as picture:
            image.paste(picture.convert("RGB").crop((0, HEAD, *SIZE)).reduce(2), (x, y + 18))
        ImageDraw.Draw(image).text((x + 4, y + 3), name, fill="#202428", font=font(11))
    text = PngInfo()
    text.add_text("scenarios", " ".join(names))
    few = image.quantize(256, dither=Image.Dither.NONE)
    few.save(ROOT / "docs" / "images" / "scenarios.png", optimize=True, pnginfo=text)


def main() -> None:
    clean()
    if sys.argv[1:] == ["--sheet"]:
        sheet()
        return
    for name in sys.argv[1:] or [file.stem for file in shipped_scenarios()]:
        build(name)
        run.cache_clear()


if __name__ == "__main__":
    main()
