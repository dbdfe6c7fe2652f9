"""Plug-ins: members of families from other packages, and errors of faulty ones.

A folder NAME.dist-info on the path is what an installed distribution looks like to Python; nothing is installed.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from ruamel.yaml import YAML
from support.documented_arm import plant
from support.messages import check_message, lines_with

from dynsim.record import Record

pytestmark = pytest.mark.long

HERE = Path(__file__).parent
DOCS = HERE.parents[1] / "docs" / "extending.md"
CART = """duration_s: 1
plant: {type: cart_pole, motor: {type: small_servo}}
controller: {type: sway, amplitudes: {slide: 0.1}, period_s: 1}
"""
# The braced arm of the documentation, its hand on a helix that is nearly a line.
MOUND = f"""duration_s: 0.2
{plant("small_servo")}controller:
  type: joint_pd
  hand:
    joints: [joint_1, joint_4, joint_5]
    path: {{type: helix, frame: start, center_m: [-0.05, 0, 0], radius_m: 0.05, pitch_m: 0.01}}
surfaces:
  mound: {{type: ellipsoid, center_m: [0.69282032303, 0, -0.2], half_axes_m: [0.8, 0.5, 0.2], yaw_deg: 20}}
contacts:
  points: {{elbow: {{body: link_4, surface: mound}}}}
  reference_tolerance_m: 0.02
"""


def distribution(folder: Path, name: str, points: Mapping[str, Mapping[str, str]], version: str = "0.1") -> None:
    """What installing a distribution would leave behind: its name, version and entry points."""
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n", encoding="utf-8")
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in members.items()) for group, members in points.items()]
    (info / "entry_points.txt").write_text("\n".join(lines), encoding="utf-8")


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder in which the example parts are installed."""
    project = tomllib.loads((HERE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    distribution(tmp_path, project["name"], project["entry-points"], project["version"])
    (tmp_path / "example_parts").symlink_to(HERE / "example_parts")
    return tmp_path


def python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(folder), *sys.path])
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path, "COLUMNS": "200"},
        capture_output=True,
        text=True,
        timeout=300,
    )


def dynsim(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return python(folder, "-m", "dynsim", *arguments)


@pytest.mark.parametrize(("name", "text"), [("cart", CART), ("mound", MOUND)])
def test_a_scenario_of_parts_from_outside_runs(installed: Path, name: str, text: str) -> None:
    (installed / f"{name}.yaml").write_text(text, encoding="utf-8")
    answer = dynsim(installed, "run", f"{name}.yaml", "--out", "out", "--no-figures", "--quiet")
    assert (answer.returncode, answer.stderr) == (0, "")
    record = Record.load(installed / "out" / "record.h5")
    assert record.complete
    assert record.provenance["libraries"]["example-parts"] == "0.1"
    resolved = YAML(typ="safe").load((installed / "out" / "scenario.yaml").read_text(encoding="utf-8"))
    if name == "cart":
        # Every default of the plug-in's configurations is written out.
        assert resolved["plant"]["pole_m"] == 0.5
        assert resolved["plant"]["motor"]["gear_ratio"] == 200.0
        # The cart has gone to its amplitude and comes back, a little late.
        assert record["q"][:, 0].max() == pytest.approx(0.1, rel=0.1)
        assert abs(record["q"][-1, 0]) < 0.02
    else:
        assert np.abs(record["contact_gap"]).max() < 1e-9
        path = resolved["controller"]["hand"]["path"]
        assert (path["type"], path["period_s"]) == ("helix", 10.0)
        moved = [0.05 * np.cos(0.04 * np.pi) - 0.05, 0.05 * np.sin(0.04 * np.pi), 0.01 * 0.02]
        assert np.allclose(record["target_position"][-1] - record["hand_position"][0], moved, rtol=0.0, atol=1e-12)
    # A resolved scenario gives the same simulation.
    again = dynsim(installed, "check", "out/scenario.yaml")
    assert (again.returncode, again.stderr) == (0, "")


def test_list_and_schema_know_the_parts_from_outside(installed: Path) -> None:
    listed = dynsim(installed, "list")
    assert (listed.returncode, listed.stderr) == (0, "")
    assert "A pole on a cart that a motor drives along x." in listed.stdout
    for name in ("cart_pole", "sway", "helix", "ellipsoid", "small_servo"):
        assert re.search(rf"^\s*{name}\s", listed.stdout, re.MULTILINE), name
    answer = dynsim(installed, "schema")
    validator = jsonschema.Draft202012Validator(json.loads(answer.stdout))
    validator.check_schema(json.loads(answer.stdout))
    for text in (CART, MOUND):
        assert list(validator.iter_errors(YAML(typ="safe").load(text))) == []
        wrong = text.replace("small_servo", "small_servant").replace("yaw_deg: 20", "yaw_deg: east")
        assert list(validator.iter_errors(YAML(typ="safe").load(wrong)))


# What is replaced in the scenario of the cart, by what, and the error.
MISTAKES = [
    ("type: cart_pole", "type: cart_polo", [":2: plant.type", "'cart_polo'", "'cart_pole'"]),
    ("motor: {", "pole_kgs: 1, motor: {", [":2: plant.pole_kgs", "'pole_kg'"]),
    ("motor: {", "pole_kg: -1, motor: {", [":2: plant.pole_kg = -1"]),
    ("motor: {", "pole_kg: true, motor: {", [":2: plant.pole_kg = True"]),
    ("small_servo}", "small_servo, ratio: 1}", [":2: plant.motor.ratio", "'gear_ratio'"]),
    (", motor: {type: small_servo}", "", ["plant.motor"]),
    ("{slide: 0.1}", "{wheel: 0.1}", ["'wheel'", "slide"]),
]


def test_errors_in_a_section_of_a_part_from_outside_name_line_and_key(installed: Path) -> None:
    for k, (old, new, _) in enumerate(MISTAKES):
        assert old in CART
        (installed / f"case{k}.yaml").write_text(CART.replace(old, new), encoding="utf-8")
    answer = dynsim(installed, "check", *(f"case{k}.yaml" for k in range(len(MISTAKES))))
    assert answer.returncode == 2
    # Where it starts is said before what is wrong with its path.
    assert all(line.endswith("[m]:") or line.split()[0] == "hand" for line in answer.stdout.splitlines())
    for k, (line, (_, _, names)) in enumerate(zip(answer.stderr.splitlines(), MISTAKES, strict=True)):
        assert line.startswith(f"error: case{k}.yaml:")
        check_message(line, *names)


GOOD = """from typing import Literal
from dynsim.config.base import StrictConfig
ENGINE = "dynamics"
class Config(StrictConfig):
    type: Literal["NAME"]
def build(config, context):
    return "nothing"
"""
# Module → its source, and what the one line about it says.
BROKEN = {
    "fails": ("import no_such_module", ["ModuleNotFoundError", "no_such_module"]),
    "exits": ("raise SystemExit(3)", ["SystemExit: 3"]),
    "no_config": ("", ["Config", "dynsim.config.base.StrictConfig"]),
    "no_build": (GOOD.replace("def build", "def make"), ["build(config, context)"]),
    "no_engine": (GOOD.replace("ENGINE", "engine"), ["ENGINE"]),
    "old_build": (GOOD.replace(", context", ""), ["build", "(config, context)"]),
    "misnamed": (GOOD.replace("NAME", "other"), ["Config", 'Literal["misnamed"]']),
}


def test_a_part_that_does_not_work_is_named_with_its_distribution_and_harms_nobody_else(tmp_path: Path) -> None:
    for name, (source, _) in BROKEN.items():
        (tmp_path / f"{name}.py").write_text(source.replace("NAME", name), encoding="utf-8")
        (tmp_path / f"{name}.yaml").write_text(f"duration_s: 1\nplant:\n  type: {name}\n", encoding="utf-8")
    (tmp_path / "useless.py").write_text(GOOD.replace("NAME", "useless"), encoding="utf-8")
    (tmp_path / "useless.yaml").write_text("duration_s: 1\nplant: {type: useless}\n", encoding="utf-8")
    (tmp_path / "twice.yaml").write_text("duration_s: 1\nplant: {type: twice}\n", encoding="utf-8")
    points = {name: name for name in BROKEN} | {"useless": "useless", "attribute": "no_config:__name__"}
    distribution(tmp_path, "broken-parts", {"dynsim.plants": points | {"twice": "useless"}})
    clashes = {"dynsim.plants": {"twice": "useless"}, "dynsim.surfaces": {"plane": "useless"}}
    distribution(tmp_path, "more-parts", clashes, "2.0")

    checked = dynsim(tmp_path, "check", "single_pendulum", *(f"{name}.yaml" for name in (*BROKEN, "useless", "twice")))
    assert checked.returncode == 2
    assert "single_pendulum: " in checked.stdout
    assert "Traceback" not in checked.stderr
    said, lines = checked.stderr.splitlines(), {}
    for line in said:
        if line.startswith("error: ") and (match := re.match(r"error: (?:.*/)?(\w+)\.yaml", line)):
            lines[match[1]] = line
    for name, (_, names) in BROKEN.items():
        check_message(lines[name], f"{name}.yaml:3: plant.type = '{name}'", "broken-parts 0.1", *names)
    check_message(lines["useless"], "'useless'", "Robot", "'nothing'")
    check_message(lines["twice"], "'twice'", "broken-parts 0.1", "more-parts 2.0")
    # What a scenario does not use is a warning, here and where all members are shown, and only there.
    warnings = [line for line in said if line.startswith("warning: ")]
    assert lines_with(warnings, "'plane'", "more-parts 2.0")
    assert lines_with(warnings, "'attribute'", "broken-parts 0.1", "'no_config:__name__'")
    assert len(warnings) == len(BROKEN) + 3
    assert [line for line in said if line not in warnings and not line.startswith("error: ")] == []
    for command in ("list", "schema"):
        answer = dynsim(tmp_path, command)
        assert (answer.returncode, answer.stderr.splitlines()) == (0, warnings)
        assert "serial_arm" in answer.stdout
        assert "no_build" not in answer.stdout
    run = dynsim(tmp_path, "run", "single_pendulum", "--set", "duration_s=0.1", "--no-figures", "--quiet")
    assert (run.returncode, run.stderr) == (0, "")


def test_a_build_that_fails_is_named_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "fails.py").write_text(GOOD.replace("NAME", "fails").replace('return "nothing"', "return 1 / 0"))
    (tmp_path / "fails.yaml").write_text("duration_s: 1\nplant: {type: fails}\n", encoding="utf-8")
    distribution(tmp_path, "broken-parts", {"dynsim.plants": {"fails": "fails"}})
    answer = dynsim(tmp_path, "check", "fails.yaml")
    assert answer.returncode == 2
    names = ["'fails'", "ZeroDivisionError: division by zero", "fails.py:7"]
    check_message(answer.stderr, re.compile("^error: fails.yaml: "), *names)


def test_a_scenario_of_the_packages_own_members_looks_for_no_others(tmp_path: Path) -> None:
    code = (
        "import importlib.metadata as metadata\n"
        "entry_points = metadata.entry_points\n"
        "def look(**given):\n"
        "    if given.get('group', '').startswith('dynsim'): raise LookupError('looked for entry points')\n"
        "    return entry_points(**given)\n"
        "metadata.entry_points = look\n"
        "from dynsim import load_scenario, check\n"
        "check(load_scenario('elbow_comparison', overrides={'duration_s': 0.1}))\n"
        "try: load_scenario('elbow_comparison', overrides={'plant.type': 'unknown'})\n"
        "except LookupError as error: print(error)\n"
    )
    answer = python(tmp_path, "-c", code)
    assert (answer.stdout, answer.stderr) == ("looked for entry points\n", "")


def test_the_page_shows_the_whole_project_file() -> None:
    """With the build system, without which pip makes nothing of it."""
    (block,) = re.findall(r"```toml\n(.*?)```", DOCS.read_text(encoding="utf-8"), flags=re.DOTALL)
    shown = tomllib.loads(block)
    assert shown == tomllib.loads((HERE / "pyproject.toml").read_text(encoding="utf-8"))
    assert shown["build-system"]["build-backend"] == "hatchling.build"
    assert "\npip install -e .\n" in DOCS.read_text(encoding="utf-8")


@pytest.mark.parametrize("module", sorted(path.stem for path in (HERE / "example_parts").glob("[!_]*.py")))
def test_the_documentation_shows_the_parts_as_they_are(module: str) -> None:
    """In full, without what comes before its first definition, or by the name of the file."""
    source = (HERE / "example_parts" / f"{module}.py").read_text(encoding="utf-8")
    begin = re.search(r"^(ENGINE|class) ", source, flags=re.MULTILINE)
    assert begin
    text = DOCS.read_text(encoding="utf-8")
    shown = [f"```python\n{source}```" in text, f"```python\n{source[begin.start() :]}```" in text]
    assert any(shown) or (module == "helix" and "`tests/plugins/example_parts/helix.py`" in text)


def test_the_documentation_shows_the_entry_points_as_they_are() -> None:
    text = (HERE / "pyproject.toml").read_text(encoding="utf-8")
    assert text[text.index("[project.entry-points") :] in DOCS.read_text(encoding="utf-8")
