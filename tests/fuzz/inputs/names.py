"""Hostile names of joints, bodies, points, surfaces and loads through runs, pages, exports and figures."""

from __future__ import annotations

import csv
import json
import re
import xml.etree.ElementTree as ElementTree
from functools import partial
from pathlib import Path
from random import Random
from typing import Any
from xml.sax.saxutils import quoteattr

from fuzz.case import Draft
from fuzz.inputs.simulation import QUIET
from fuzz.mutations import TEXTS, yaml_text
from fuzz.readings import Unreadable

NAMES = (
    *TEXTS, "a'b", 'a"b', "a=b", "=1+1", "+1", "@x", "-x", "<script>alert(1)</script>", "</script><script>x", "<!--",
    "]]>",
    "&amp;", "&lt;", "a,b", "a;b", "../../x", "/etc/passwd", "\u202etxt.exe", "\u200b", "a\u0300" * 40, "x" * 3000,
    "CON",
    "$x$", "\\frac{1}{2}", "$\\badcommand$", "_x_", "100 %", "{x}", "%(x)s", "'; drop table x;--", "a  b",
    "$", "`x`", "😀",
)  # fmt: skip
URDF = (
    "<robot name={robot}><link name='base'/><link name={link}><inertial><mass value='0.5'/><origin xyz='0 0 0.1'/>"
    "<inertia ixx='0.01' iyy='0.01' izz='0.01' ixy='0' ixz='0' iyz='0'/></inertial></link><joint name={joint} "
    "type='revolute'>"
    "<parent link='base'/><child link={link}/><axis xyz='0 1 0'/><limit lower='-3' upper='3' effort='9' "
    "velocity='9'/></joint></robot>"
)


def draw(rng: Random, records: Path) -> Draft:
    robot, link, joint = (rng.choice(NAMES) if rng.random() < 0.6 else sound for sound in ("r", "arm", "hinge"))
    point, surface, load, variant = (
        rng.choice(NAMES) if rng.random() < 0.35 else sound for sound in ("tip", "ground", "cable", "")
    )
    tree: dict[str, Any] = {
        "name": rng.choice(NAMES) if rng.random() < 0.3 else "names",
        "duration_s": 0.01,
        "plant": {"type": "urdf_arm", "file": "robot.urdf"},
        "surfaces": {surface: {"type": "plane", "point_m": [0, 0, -5]}},
        "contacts": {"law": "unilateral", "points": {point: {"body": link, "surface": surface}}},
        "loads": {load: {"type": "constant", "body": link, "force_N": [0, 0, 1]}},
        "metrics": {"settle_s": 0},
    }
    if rng.random() < 0.3:
        tree |= {"description": rng.choice(NAMES), "variants": {variant: {}}}
    text = URDF.format(robot=_quoted(robot), link=_quoted(link), joint=_quoted(joint))
    files: dict[str, bytes | str] = {
        "scenario.yaml": yaml_text(tree).encode("utf-8", "surrogatepass"),
        "robot.urdf": text.encode("utf-8", "surrogatepass"),
    }  # fmt: skip
    format_ = rng.choice(("csv", "joint-trajectory", "urdf-log", "mcap", "urdf", "mjcf", "view", "view", "plot"))
    record, out = "out/record.h5", f"export.{format_}"
    commands = [["run", "scenario.yaml", *QUIET, "--out", "out"]]
    if format_ == "view":
        commands.append(["view", record, "--no-open", "--out", "page.html"])
    elif format_ == "plot":
        commands.append(["plot", record, "--out", "figures"])
    else:
        source = "scenario.yaml" if format_ in ("urdf", "mjcf") else record
        commands.append(["export", source, "--format", format_, "--out", out])
    names = f"{robot[:40]!r} {link[:40]!r} {joint[:40]!r} {point[:40]!r} {surface[:40]!r} {load[:40]!r}"
    return Draft(f"{format_}: {names}", files, commands, partial(losses, format_, joint))


def _quoted(text: str) -> str:
    return quoteattr(text)


def losses(format_: str, joint: str) -> list[str]:
    """Return a file from which another program does not get the name of the joint, or a page with a strange element."""
    if format_ == "view":
        if not (page := Path("page.html")).is_file():
            raise Unreadable("no page")
        text = page.read_text(encoding="utf-8")
        alien = [word for word in ("<script>alert", "<script>x", '../../x"') if word in text]
        scripts = len(re.findall(r"</script", text, re.IGNORECASE)) - len(re.findall(r"<script\b", text, re.IGNORECASE))
        return (
            [f"the page contains {alien[0]!r}"]
            if alien
            else ["scripts are not closed as often as opened"]
            if scripts
            else []
        )
    path = Path(f"export.{format_}")
    if not path.is_file():
        raise Unreadable("no export")
    if format_ == "csv":
        with path.open(encoding="utf-8", newline="") as stream:
            csv.field_size_limit(1 << 30)
            rows = [row for row in csv.reader(stream) if row]
        lost = (
            [] if len({len(row) for row in rows if not row[0].startswith("#")}) == 1 else ["rows of different lengths"]
        )
        return lost + [f"a cell begins with {cell[0]}" for cell in rows[0] if cell[:1] in ("=", "+", "@", "\t", "\r")]
    if format_ in ("joint-trajectory", "urdf-log"):
        lines = path.read_text(encoding="utf-8")
        try:
            found_in = json.dumps(
                [json.loads(line) for line in lines.splitlines() if line.startswith("{")], ensure_ascii=False
            )
        except ValueError as error:
            return [f"a line is not JSON: {error}"]
        return (
            []
            if format_ == "joint-trajectory" or json.dumps(joint, ensure_ascii=False)[1:-1] in found_in
            else ["the joint is not named"]
        )
    if format_ in ("urdf", "mjcf"):
        root = ElementTree.parse(path).getroot()
        named = {element.get("name") for element in root.iter("joint")}
        return [] if joint in named else [f"the joint {joint[:40]!r} became {named}"[:200]]
    return []
