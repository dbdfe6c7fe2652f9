"""The site builds without warnings, makes no network request, and fits screens of desk and phone."""

from __future__ import annotations

import ast
import importlib.util
import os
import re
import subprocess
import sys
from fcntl import LOCK_EX, flock
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
from PIL import Image
from support.messages import lines_with, says

import dynsim
from dynsim.hardware.servo_map import Safety, ServoEntry, _MapFile
from dynsim.scenario import ScenarioConfig
from dynsim.system.shipped import shipped_scenarios

pytest.importorskip("mkdocs")
pytest.importorskip("material")
pytest.importorskip("mkdocstrings")

ROOT = Path(__file__).parents[2]
OPENED = (
    "index", "gallery", "reference/figures", "getting-started", "python", "how-to/export", "reference/scenario-keys",
    "reference/servo-map-keys", "reference/python", "theory/contact", "validation/bracing", "notebooks/sweep",
)  # fmt: skip

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as the command builds it, with stills, figures and notebooks; a warning is an error."""
    folder = tmp_path_factory.mktemp("site")
    gallery = [sys.executable, "docs/site/gallery.py", "single_pendulum"]
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", "docs/site/mkdocs.yml"]
    package = str(Path(dynsim.__file__).parents[1])
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": package}
    (ROOT / "build").mkdir(exist_ok=True)
    # Workers of pytest build sites after one another: each draws the figures that are missing, into the same folder.
    with (ROOT / "build" / "site.lock").open("w") as lock:
        flock(lock, LOCK_EX)
        subprocess.run(gallery, cwd=ROOT, check=True, timeout=1800, capture_output=True)
        done = subprocess.run(
            [*command, "-d", str(folder)],
            cwd=ROOT, capture_output=True, text=True, timeout=1800, check=False, env=environment,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder


def test_every_link_within_the_site_leads_somewhere(site: Path) -> None:
    broken = []
    for page in site.rglob("*.html"):
        if page.name == "404.html":
            continue
        for link in re.findall(r'(?:href|src)="([^"]+)"', page.read_text(encoding="utf-8")):
            parts = urlsplit(link)
            if parts.scheme or not parts.path:
                continue
            if not (page.parent / unquote(parts.path)).resolve().exists():
                broken.append((str(page.relative_to(site)), link))
    assert broken == []


def test_the_reference_has_every_command_and_every_key(site: Path) -> None:
    commands = (site / "reference" / "commands.html").read_text(encoding="utf-8")
    for name in ("run", "compare", "plan", "sweep", "export", "hw replay", "hw calibrate"):
        assert f"<code>dynsim {name}</code>" in commands, name
    keys = (site / "reference" / "scenario-keys.html").read_text(encoding="utf-8")
    for name in ScenarioConfig.model_fields:
        assert f"<code>{name}</code>" in keys, name
    keys = (site / "reference" / "servo-map-keys.html").read_text(encoding="utf-8")
    for name in (*_MapFile.model_fields, *Safety.model_fields, *ServoEntry.model_fields):
        assert f"<code>{name}</code>" in keys, name
    gallery = (site / "gallery.html").read_text(encoding="utf-8")
    for file in shipped_scenarios():
        assert f'id="{file.stem}"' in gallery
        with Image.open(site / "gallery" / file.stem / "still.png") as still:
            assert still.size == (480, 300)
            assert len(still.getcolors(still.width * still.height)) > 20
    for kept in ("film.gif", "view.html"):
        assert (site / "gallery" / "single_pendulum" / kept).is_file()
    assert says(gallery, "ledger row")


def figure_names() -> set[str]:
    """The names of all figures in the sources: keys of the mappings from file names to drawing functions."""
    names: set[str] = set()
    for file in (ROOT / "dynsim" / "draw" / "figures").glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
            named = getattr(node, "name", getattr(target, "id", ""))
            if named not in ("figures", "comparisons", "makers", "figures_of_run", "FIGURES", "COMPARISONS"):
                continue
            for part in ast.walk(node):
                if isinstance(part, ast.Dict):
                    names |= {key.value for key in part.keys if isinstance(key, ast.Constant)}
                if isinstance(part, ast.Subscript) and isinstance(part.ctx, ast.Store):
                    names.add(part.slice.value)
    return names


def test_the_catalogue_has_every_figure_with_a_picture(site: Path) -> None:
    page = (site / "reference" / "figures.html").read_text(encoding="utf-8")
    shown = re.findall(r'<img alt="(\w+)" src="\.\./(figures/\d+_\w+\.png)"', page)
    assert {"energy", "compare_energy", "fig_13", "table_iii", "sweep_pareto", "plan_heat"} <= figure_names()
    assert figure_names() - {name for name, _ in shown} == set()
    for name, file in shown:
        assert f"<code>{name}</code>" in page
        assert (site / file).stat().st_size > 5000, file


def test_notebooks_have_their_results(site: Path) -> None:
    """Pictures and printed results of the last cells, and no warning, which would contain paths of this machine."""
    for name, result in (("urdf_arm", " on floor: 0."), ("pressing", "optimal"), ("sweep", "standard deviation")):
        page = (site / "notebooks" / f"{name}.html").read_text(encoding="utf-8")
        assert page.count("data:image/png;base64") >= 1, name
        outputs = "".join(
            re.findall(r'<div class="jp-Cell-outputWrapper">.*?(?=<div class="jp-Cell |$)', page, re.DOTALL)
        )
        assert result in outputs, name
        assert str(ROOT) not in page


def test_the_picture_of_all_scenarios_has_them_all() -> None:
    """Drawn again with ``python docs/site/gallery.py --sheet``."""
    with Image.open(ROOT / "docs" / "images" / "scenarios.png") as picture:
        assert picture.info["scenarios"].split() == [file.stem for file in shipped_scenarios()]


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("size", [(1280, 800), (390, 844)], ids=["desk", "phone"])
def test_a_browser_without_a_network_shows_pages(browser: Any, site: Path, size: tuple[int, int], dark: bool) -> None:
    """No error in the console, nothing asked for from elsewhere, no page wider than the screen."""
    width, height = size
    context = browser.new_context(
        viewport={"width": width, "height": height}, offline=True, color_scheme="dark" if dark else "light"
    )
    complaints: list[str] = []
    requests: list[str] = []
    page = context.new_page()
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    page.on("request", lambda request: requests.append(request.url))
    pictures = os.environ.get("DYNSIM_SCREENSHOTS")
    for name in OPENED:
        page.goto((site / f"{name}.html").as_uri())
        scheme = page.evaluate("document.body.getAttribute('data-md-color-scheme')")
        assert scheme == ("slate" if dark else "default")
        assert page.evaluate("document.documentElement.scrollWidth") <= width, name
        if pictures:
            page.screenshot(path=str(Path(pictures, f"{name.replace('/', '_')}_{width}_{scheme}.png")))
    assert complaints == []
    assert [url for url in requests if not url.startswith(("file:", "data:", "blob:", "about:"))] == []
    context.close()


def test_search_finds_a_page_from_the_disk(browser: Any, site: Path) -> None:
    context = browser.new_context(viewport={"width": 1280, "height": 800}, offline=True)
    page = context.new_page()
    page.goto((site / "index.html").as_uri())
    page.fill("input.md-search__input", "joint-trajectory")
    page.wait_for_selector(".md-search-result__link", timeout=60_000)
    assert page.locator(".md-search-result__link").count() > 0
    context.close()


def reference() -> Any:
    """The module that generates pages."""
    spec = importlib.util.spec_from_file_location("reference", ROOT / "docs" / "site" / "reference.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_titles_of_keys_are_those_of_families() -> None:
    text = reference().scenario_keys()
    assert "## Plant serial_arm\n" in text
    assert lines_with(text, re.compile(r"^\| `duration_s` \|"), "> 0")
    assert links_without_heading(text) == set()


def links_without_heading(text: str) -> set[str]:
    """Links of a page within itself that lead nowhere."""
    headings = {line[3:].lower().replace(" ", "-") for line in text.splitlines() if line.startswith("## ")}
    return set(re.findall(r"\]\(#([^)]+)\)", text)) - headings


def test_every_key_of_servo_maps_has_a_meaning_and_its_default() -> None:
    text = reference().servo_map_page()
    assert lines_with(text, re.compile(r"^\| `watchdog` \|"), "0.02", "2.54", "`0.2`")
    assert lines_with(text, re.compile(r"^\| `velocity` \|"), "> 0", "[rad/s]")
    rows = [line for line in text.splitlines() if line.startswith("| `")]
    assert len(rows) > 40
    assert [row for row in rows if row.endswith("|  |")] == []
    assert links_without_heading(text) == set()
