"""Films, tables and live pages of all shipped scenarios: ``python docs/site/gallery.py [SCENARIO…]``.

Writes to build/gallery/NAME, from where the site takes them; what is there already is kept.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from dynsim.scenario import load_scenario, shipped_scenarios, variant_names

BUILT = Path(__file__).parents[2] / "build" / "gallery"
VIEW, FILM, TABLE = "view.html", "film.gif", "table.txt"


def build(name: str) -> None:
    """Run a scenario with all its variants; keep its page, its table and a film."""
    folder = BUILT / name
    if (folder / FILM).exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    program = [sys.executable, "-m", "dynsim"]
    several = len(variant_names(name)) > 1
    command = ["compare" if several else "run", name, "--out", str(folder / "run")]
    done = subprocess.run([*program, *command], capture_output=True, text=True, check=False)
    table = done.stdout.replace(str(folder / "run"), f"results/{name}")
    (folder / TABLE).write_text(table, encoding="utf-8")
    if not (folder / "run" / VIEW).exists():
        return  # a run that is to stop, or has no scene
    film = ["animate", str(folder / "run"), "--fps", "8", "--size", "480x300", "--out", str(folder / FILM)]
    subprocess.run([*program, *film], capture_output=True, check=True)
    shutil.copy(folder / "run" / VIEW, folder / VIEW)
    shutil.rmtree(folder / "run")


def page() -> str:
    """The page of the gallery, with what has been built."""
    parts = [
        "# Gallery\n\nEvery shipped scenario. Films, tables and pages that turn in your hand are built by "
        "`python docs/site/gallery.py`.\n"
    ]
    for file in shipped_scenarios():
        name = file.stem
        scenario = load_scenario(name)
        parts.append(f"\n## {name}\n\n{scenario.config.description.strip()}\n")
        folder = BUILT / name
        if (folder / FILM).exists():
            parts.append(f"\n![{name}](gallery/{name}/{FILM})\n")
        if (folder / VIEW).exists():
            parts.append(f'\n<a href="gallery/{name}/{VIEW}">See it live</a>\n')
        if (folder / TABLE).exists():
            text = (folder / TABLE).read_text(encoding="utf-8").rstrip()
            parts.append(f'\n??? note "Table"\n\n    ```text\n{_indented(text)}\n    ```\n')
        names = variant_names(name)
        command = f"dynsim compare {name}" if len(names) > 1 else f"dynsim run {name}"
        parts.append(f"\n```sh\n{command}\n```\n")
    return "".join(parts)


def _indented(text: str) -> str:
    return "\n".join(f"    {line}" for line in text.splitlines())


def main() -> None:
    for name in sys.argv[1:] or [file.stem for file in shipped_scenarios()]:
        print(name, flush=True)
        build(name)


if __name__ == "__main__":
    main()
