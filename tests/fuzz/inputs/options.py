"""Options of commands: sweeps, plans, comparisons, pages, figures, films and exports; most of them are valid."""

from __future__ import annotations

import csv
import xml.etree.ElementTree as ElementTree
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from fuzz.case import SHIPPED, Draft
from fuzz.inputs.override import path_of, real_keys
from fuzz.inputs.simulation import QUIET, varied
from fuzz.mutations import at, is_number, mutate_text, scaled, yaml_text
from fuzz.readings import Unreadable, yaml_tree

# Records with figures, and all records, which can be exported.
DRAWN = ("arm.h5", "snake.h5")
RECORDS = (*DRAWN, "rig.h5")
SWEPT = ("single_pendulum", "elbow_comparison", "snake_positioning", "link_tolerance")
EXPORTED = (
    "six_axis_arm", "free_flyer", "elbow_comparison", "brace_on_shapes", "mobile_reach", "snake_positioning_dynamic",
    "wall_push",
)  # fmt: skip
NUMBER_TEXTS = ("0", "-1", "nan", "inf", "1e9", "1e-9", "1e300", "", "x", "0x10", "1_0", "１", "2.5")
# Settings of short sweeps, and options that many sweeps do not have.
SHORT = ["--jobs", "1", "--out", "out", "--set", "duration_s=0.01", "--set", "metrics.settle_s=0"]
ODD = ("--keep-records all", "--seed -1", "--count 0", "--variants x", "--seed 12", "--resume")
# Options of each command with values, most of them valid. An option with * is always set; a flag has the value "".
OPTIONS = {
    "compare": {"--jobs": "1", "--format": "png pdf svg gif", "--set": "integrator.rtol=1e-7 a=1"},
    "plan": {
        "*--count": "0:1 1:1 1:1 0:0 1:2", "--phases": "1:2 2:2 0:1 5", "*--starts": "1", "*--jobs": "1",
        "*--candidates": "link_4 link_7 link_4:link_5 elbow_4 link_4,elbow_7 link_99",
        "--along": "0.5 1", "--radius": "0.01 0", "--surface": "floor x",
        "--weight": "peak=0.1 peak=0 peak=-1 x=1 peak=nan", "--clearance": "0.005 0", "--min-force": "0.5 2",
        "--gains": "500 500,50 0 x", "--seed": "3", "--friction-error": "0.1", "--explain": "", "--exhaustive": "",
        "--require": "hand_error_m=0.01 heat_ratio=2 mass_error=0.1 mass_error=1 rating_share=1 x=1",
        "--vary": "contacts.friction=0.05:0.2:2 surfaces.floor.point_m.2=-0.01,0 contacts.friction=0:1:x a=1 x",
    },
    "view": {"*--out": "page.html page.html x/y.html ä.html . page", "*--no-open": "", "--ghost": "", "--trust": ""},
    "plot": {"*--out": "figures f/g ä", "--format": "svg pdf x", "--trust": ""},
    "animate": {
        "*--out": "film.gif film.gif film.mp4 film.avi film", "*--size": "160x160 200x160 320x180 64x64",
        "*--fps": "5 10", "*--quiet": "", "--view": "iso side top x", "--speed": "1 0.5 3", "--hold": "0 0.1",
        "--plot": "none q marker x [red]",
    },
    "export": {
        "*--out": "out.txt a/b.txt ö .", "*--format": "csv joint-trajectory urdf-log mcap", "--rate": "50 100 1e3 33.3",
        "--trust": "", "--variant": "x",
    },
}  # fmt: skip


def draw(rng: Random, records: Path, kind: str) -> Draft:
    if kind == "sweep_plan":
        command, rows = _sweep(rng)
        return Draft(" ".join(command)[:300], {}, [command], partial(sweep_losses, rows))
    if kind in ("compare", "plan", "robot_export"):
        names = {"compare": SWEPT, "plan": ("pressing",), "robot_export": EXPORTED}[kind]
        tree, mutation = varied(rng, rng.choice(names), rng.choice((0, 1)))
        tree["duration_s"] = 0.05
        losses = None
        if kind == "robot_export":
            format_ = rng.choice(("urdf", "mjcf"))
            command = ["export", "scenario.yaml", "--format", format_, "--out", "robot.xml"]
            losses = partial(robot_losses, format_)
        else:
            command = [kind, "scenario.yaml", *QUIET, "--out", "out", *_options(rng, kind)]
        if kind == "compare":
            tree["variants"] = {name: {"record": {"rate_hz": 200}} for name in rng.choice(("ab", "a", "äß", "x1"))}
        elif kind == "plan" and rng.random() < 0.9:
            command.append("--no-verify")
        files: dict[str, bytes | str] = {"scenario.yaml": yaml_text(tree).encode()}
        return Draft(f"{mutation}: {' '.join(command)}", files, [command], losses)
    several, any_record = kind != "export" and rng.random() < 0.2, kind == "export" or rng.random() < 0.1
    names = rng.sample(RECORDS if any_record else DRAWN, 2 if several else 1)
    command = [kind, *names, *_options(rng, kind)]
    return Draft(" ".join(command), {name: (records / name).read_bytes() for name in names}, [command], output_losses)


def _options(rng: Random, command: str) -> list[str]:
    words = []
    for option, values in OPTIONS[command].items():
        if option.startswith("*") or rng.random() < 0.25:
            words.append(option.strip("*"))
            if values:
                words.append(rng.choice(values.split() if rng.random() < 0.9 else NUMBER_TEXTS))
    return words


def _sweep(rng: Random) -> tuple[list[str], int | None]:
    """Return a sweep and the number of its runs, None if it is probably invalid."""
    name = rng.choice(SWEPT)
    tree = yaml_tree((SHIPPED / f"{name}.yaml").read_text(encoding="utf-8"))
    keys = [key for key in real_keys(name) if is_number(at(tree, path_of(key))) and key != "duration_s"]
    variants, expressions, rows, sampled = [*(tree.get("variants") or {})], [], 1, False
    for key in rng.sample(keys, min(len(keys), rng.choice((1, 1, 2)))):
        old = at(tree, path_of(key))
        law = rng.choice(("list", "list", "range", "range", "uniform", "normal", "any"))
        low, high = sorted((scaled(rng, old), scaled(rng, old)))
        count = rng.choice((2, 3))
        if law in ("list", "any"):
            values = sorted({scaled(rng, old) for _ in range(count)} | {old})
            text, rows = f"{key}={','.join(map(str, values))}", rows * len(values)
        elif law == "range":
            text, rows = f"{key}={low}:{high + 1}:{count}", rows * count
        else:
            text, sampled = f"{key}={law}({low},{abs(high) + abs(low) + 1e-3})", True
        if rng.random() < 0.15:
            text, rows = mutate_text(rng, text)[0].decode("utf-8", "replace").replace("\x00", "").strip("\n")[:3000], 0
        expressions += ["--sample" if law in ("uniform", "normal") else "--grid", text]
    count = rng.choice((1, 2, 3)) if sampled else 1
    command = ["sweep", name, *expressions, *QUIET, *SHORT]
    command += ["--count", str(count)] if count > 1 else []
    if variants and rng.random() < 0.3:
        command += ["--variants", ",".join(variants[:2])]
        rows *= len(variants[:2])
    if rng.random() < 0.15:
        command += rng.choice(ODD).split()
        rows = 0
    return command, rows * count or None


def sweep_losses(rows: int | None) -> list[str]:
    """Return faults of the table of a sweep."""
    if not (table := Path("out/sweep.csv")).is_file():
        raise Unreadable("no table")
    with table.open(encoding="utf-8", newline="") as stream:
        count = len(list(csv.DictReader(stream)))
    return [] if rows is None or count == rows else [f"the table has {count} runs instead of {rows}"]


def output_losses() -> list[str]:
    """Return faults of the files that a command has written."""
    lost = []
    for path in Path().rglob("*"):
        if not path.is_file() or path.suffix in (".h5", ".urdf", ".yaml") or path.parts[0] in ("data", "robots"):
            continue
        data = path.read_bytes()
        begins = {".png": b"\x89PNG", ".pdf": b"%PDF", ".gif": b"GIF8", ".svg": b"<?xml", ".html": b"<!"}
        if not data or not data.startswith(begins.get(path.suffix, b"")):
            lost.append(f"{path.suffix} file is empty or has another format")
    return lost


def robot_losses(format_: str) -> list[str]:
    """Return the mass that an exported robot lacks, and the joints."""
    if not (path := Path("robot.xml")).is_file():
        raise Unreadable("nothing was exported")
    from dynsim.scenario import build, load_scenario

    robot = build.robot(load_scenario("scenario.yaml"))
    root = ElementTree.parse(path).getroot()
    if format_ == "urdf":
        names = {str(joint.get("name")) for joint in root.findall("joint") if joint.get("type") != "fixed"}
        masses = [float(mass.get("value", "nan")) for mass in root.iter("mass")]
    else:
        import mujoco

        model: Any = mujoco.MjModel.from_xml_path(str(path))
        names = {model.joint(k).name for k in range(model.njnt)}
        masses = [float(mass) for mass in model.body_mass]
    # The six coordinates of a floating base are a single joint, or none.
    lost = [f"joint {name!r} is not exported" for name in robot.joint_names if "." not in name and name not in names]
    said = sum(link.inertia.mass for link in robot.links)
    if not abs(sum(masses) - said) <= 1e-6 * max(said, 1e-9):
        lost.append(f"masses of {said:g} kg became {sum(masses):g} kg")
    return lost
