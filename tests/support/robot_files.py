"""Robot files of makers, from packages: the files, the corrections that a message names, and what each file does."""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
from ruamel.yaml import YAML

from dynsim.compile.model import Model
from dynsim.engine import simulate
from dynsim.errors import DynsimError, ModelError
from dynsim.model.description import Robot
from dynsim.model.urdf.reader import Corrections, read_urdf, read_xml
from dynsim.scenario import load_scenario
from support.urdf_in_pinocchio import plain_text

FOLDER = "DYNSIM_ROBOT_FILES"
PACKAGES = Path(__file__).parents[1] / "data" / "robot_packages.txt"
# A thousand random objects of one link.
OMITTED = "random_urdfs"
# Files that are not robots: an include without links, a soft body, and a text that is not XML.
NOT_ROBOTS = {"finger_macro.urdf", "torus_deform.urdf", "test.urdf"}
SPHERE = [1e-3, 0.0, 0.0, 1e-3, 0.0, 1e-3]
ENERGY = 1e-6


def robot_files(folder: Path, made: Path) -> dict[str, Path]:
    """Return a mapping from names to URDF files of the packages; xacro files are expanded into ``made``."""
    files = {
        str(path.relative_to(folder)): path for path in sorted(folder.rglob("*.urdf")) if OMITTED not in path.parts
    }
    for path in sorted(folder.rglob("*.xacro")):
        with contextlib.suppress(Exception, SystemExit):
            text = expanded(path, folder)
            # Fragments name parents that another file defines.
            defined = set(re.findall(r'<link name="([^"]*)"', text))
            if defined and set(re.findall(r'<(?:parent|child) link="([^"]*)"', text)) <= defined:
                name = str(path.relative_to(folder))
                files[name] = made / f"{len(files)}_{path.name.split('.')[0]}.urdf"
                files[name].write_text(text)
    return files


def expanded(path: Path, folder: Path) -> str:
    """Return the text of a xacro file; packages are folders with their name, with or without its usual ending."""
    sys.path.append(str(folder))
    try:
        import xacro
        from xacro import substitution_args
    finally:
        sys.path.remove(str(folder))

    def find(package: str) -> str:
        bare = package.removesuffix("_support")
        names = (package, bare, f"{bare}_description")
        return str(next(p for p in sorted(folder.rglob("*")) if p.is_dir() and p.name in names))

    substitution_args._eval_find = find
    with contextlib.redirect_stderr(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return str(xacro.process_file(str(path)).toprettyxml(indent=" "))


@dataclass
class CorrectedFile:
    """A file with the corrections that messages have named so far."""

    path: Path
    text: str
    plant: dict[str, Any] = field(default_factory=dict)
    messages: list[str] = field(default_factory=list)

    def read(self) -> Robot:
        self.path.write_text(self.text)
        links = {}
        for name, keys in self.plant.get("links", {}).items():
            stated = {}
            if "mass_kg" in keys:
                stated["mass"] = keys["mass_kg"]
            if "inertia_kg_m2" in keys:
                stated["tensor"] = 1e-3 * np.eye(3)
            links[name] = stated
        joints = {name: {"lower": -1.0, "upper": 1.0} for name in self.plant.get("joints", {})}
        nearest, floating = self.plant.get("inertia") == "nearest", self.plant.get("base") == "floating"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return read_urdf(self.path, None, Corrections(links, joints, nearest=nearest, floating=floating))

    def correct(self, message: str) -> bool:
        """Apply all corrections that a message names; return False if it names none."""
        self.messages.append(message)
        before = self.text, json.dumps(self.plant)
        lines = self.text.splitlines()
        for line in message.splitlines():
            for pattern, apply in FIXES.items():
                if match := re.search(pattern, line):
                    at = re.search(r"\.urdf:(\d+):", line)
                    apply(self, lines, int(at[1]) - 1 if at else 0, match)
        self.text = "\n".join(lines)
        return (self.text, json.dumps(self.plant)) != before

    def set(self, *keys: str, value: Any) -> None:
        node = self.plant
        for key in keys[:-1]:
            node = node.setdefault(key, {})
        node[keys[-1]] = value


Fix = Callable[[CorrectedFile, list[str], int, re.Match[str]], None]


def _edit(replace: Callable[[str, re.Match[str]], str]) -> Fix:
    def apply(_: CorrectedFile, lines: list[str], at: int, match: re.Match[str]) -> None:
        lines[at] = replace(lines[at], match)

    return apply


def _end(_: CorrectedFile, lines: list[str], at: int, match: re.Match[str]) -> None:
    lines[at] = "".join(itertools.takewhile(str.isprintable, lines[at]))


# What a message asks for, and how a user does it.
FIXES: dict[str, Fix] = {
    r"plant\.inertia: nearest": lambda robot, *_: robot.set("inertia", value="nearest"),
    r"plant\.base: floating": lambda robot, *_: robot.set("base", value="floating"),
    r"plant\.links\.(\S+)\.inertia_kg_m2 or density": lambda robot, _, __, match: robot.set(
        "links", match[1], "inertia_kg_m2", value=SPHERE
    ),
    r"plant\.links\.(\S+)\.mass_kg": lambda robot, _, __, match: robot.set("links", match[1], "mass_kg", value=0.1),
    r"plant\.joints\.(\S+)\.limit_(m|deg)": lambda robot, _, __, match: robot.set(
        "joints", match[1], f"limit_{match[2]}", value=[-1.0, 1.0]
    ),
    r"the mass behind it \(([^)]*)\).*set mass_kg": lambda robot, _, __, match: robot.set(
        "links", match[1], value={"mass_kg": 0.1, "inertia_kg_m2": SPHERE}
    ),
    r"='([^']*)'> is not a finite number; separate numbers by spaces only, e\.g\. \"([^\"]*)\"": _edit(
        lambda line, match: line.replace(match[1], match[2])
    ),
    r"='([^']*)'> has 4 entries, 3 are needed": _edit(
        lambda line, match: line.replace(match[1], " ".join(match[1].split()[:3]))
    ),
    r"link '([^']*)' is not in the file; add it": lambda _, lines, __, match: (
        lines.insert(next(k for k, line in enumerate(lines) if "</robot>" in line), f'<link name="{match[1]}"/>')
        if not any(f'<link name="{match[1]}"/>' in line for line in lines)
        else None
    ),
    r"<limit> has no (velocity|effort); add it": _edit(
        lambda line, match: line.replace("<limit", f'<limit {match[1]}="0"')
    ),
    r"is 'spherical'; known: revolute": _edit(lambda line, _: line.replace("spherical", "continuous")),
    r"remove the text after </robot>": _end,
}


def outcome(path: Path, folder: Path, made: Path) -> dict[str, Any]:
    """Return what a file does: reading, corrections, agreement with Pinocchio, and a fall of 0.3 s."""
    text = path.read_bytes().decode("utf-8", errors="replace")
    robot = CorrectedFile(made / "case.urdf", text.replace("\r\n", "\n"))
    result: dict[str, Any] = {}
    built = None
    for _ in range(3):
        try:
            built = robot.read()
            break
        except ModelError as error:
            if "this is a xacro file" in str(error):
                robot.messages.append(str(error))
                robot.text = expanded(path, folder)
            elif not robot.correct(str(error)):
                break
    result["read"] = "refused" if built is None else "loads after corrections" if robot.messages else "loads"
    if robot.messages:
        # The first message names all problems if its corrections are enough.
        result["messages"] = len(robot.messages)
        result["problems"] = len(robot.messages[0].splitlines())
    if built is None:
        return result
    result["joints"] = len(built.links)
    try:
        model = Model(built)
    except ModelError as error:
        result["motion"] = "without masses" if "no mass" in str(error) else str(error)
        return result
    if not any(link.joint_of_rows for link in built.links) and not robot.plant:
        result["agrees"] = bool(difference(robot.path, model) < 1e-9)
    result |= fall(robot, made)
    return result


def fall(robot: CorrectedFile, made: Path) -> dict[str, Any]:
    """Return the relative energy residual of a fall of 0.3 s, or why it does not start."""
    for corrected in (False, True):
        plant = {"type": "urdf_arm", "file": str(robot.path), **robot.plant}
        scenario = {"duration_s": 0.3, "plant": plant, "contacts": {"law": "unilateral"}}
        YAML(typ="safe").dump(scenario, made / "case.yaml")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                record = simulate(load_scenario(made / "case.yaml"), pictured=False)
        except DynsimError as error:
            if corrected or not robot.correct(str(error)):
                return {"motion": str(error).rpartition(".yaml")[2]}
            continue
        motion = "falls after corrections" if corrected else "falls"
        return {"motion": motion, "ledger": record.summary["energy_residual_relative"]}
    raise AssertionError


def difference(path: Path, model: Model) -> float:
    """Return the largest relative difference of M and h from Pinocchio's at three random states."""
    theirs = pinocchio.buildModelFromXML(plain_text(read_xml(path), "robot"))
    data, rng, largest = theirs.createData(), np.random.default_rng(0), 0.0
    weight = 9.81 * sum(link.inertia.mass for link in model.robot.links)
    order = [theirs.joints[theirs.getJointId(name)].idx_v for name in model.joint_names]
    for _ in range(3):
        q, v, turn = rng.uniform(-1, 1, model.n), rng.uniform(-1, 1, model.n), np.zeros(model.n)
        turn[order] = q
        at = pinocchio.integrate(theirs, pinocchio.neutral(theirs), turn)
        rates = np.zeros(model.n)
        rates[order] = v
        M = pinocchio.crba(theirs, data, at)
        M = (np.triu(M) + np.triu(M, 1).T)[np.ix_(order, order)]
        h = pinocchio.nle(theirs, data, at, rates)[order]
        # The weight is the scale of h, which vanishes for horizontal motion.
        for ours, other, scale in ((model.mass_matrix(q), M, 0.0), (model.bias_forces(q, v), h, weight)):
            largest = max(largest, float(np.abs(ours - other).max() / (np.abs(other).max() + scale)))
    return largest


def outcomes(folder: Path, made: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield what every file does."""
    for name, path in robot_files(folder, made).items():
        yield name, outcome(path, folder, made)
