"""URDF files: the shipped arm with damaged elements, attributes, numbers and bytes."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from random import Random

from fuzz.case import SHIPPED, Draft
from fuzz.inputs.scenario import OLD, SHORT
from fuzz.mutations import mutate_bytes, mutate_text
from fuzz.readings import urdf_losses

SCENARIO = b"name: arm\nduration_s: 0.01\nplant: {type: urdf_arm, file: robot.urdf}\n"
NUMBERS = (
    "", " ", "0", "-1", "1e-3", "1e-320", "1e308", "1e999", "-0", "nan", "inf", "-inf", "1_9.2", "1,5", "1 2",
    "1 2 3", "0x10", "１２", "٣", "²", "5.", ".5", "+1", " 7 ", "\t7", "7 kg", "1e", "--1", "${mass}", "$(find x)",
    "1.0.0", "true", "7\u00a0", "7\u200b", "1;2", "1e5", "1d3", "1f",
)  # fmt: skip
NAMES = (
    "",
    " ",
    "base",
    "world",
    "hand",
    "turret",
    "no such",
    "a b",
    "[red]x[/]",
    "\u202ex",
    "é",
    "x" * 300,
    "..",
    "0",
    "link_1",
)
TAGS = (
    "link",
    "joint",
    "inertial",
    "mass",
    "inertia",
    "origin",
    "axis",
    "limit",
    "mimic",
    "dynamics",
    "safety_controller",
    "x",
    "Mass",
    "xacro:macro",
)
TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical", "Revolute", "", "x")


def draw(rng: Random, records: Path) -> Draft:
    text = (SHIPPED / "robots" / "six_axis_arm.urdf").read_text(encoding="utf-8")
    choice = rng.random()
    if choice < 0.7:
        root = ElementTree.fromstring(text)
        mutation = "; ".join(_mutate(rng, root) for _ in range(rng.choice((1, 1, 1, 2, 3))))
        data = ElementTree.tostring(
            root, encoding=rng.choice(("utf-8",) * 6 + ("us-ascii", "utf-16", "latin-1")), xml_declaration=True
        )
    elif choice < 0.85:
        data, mutation = mutate_text(rng, text)
    else:
        data, mutation = mutate_bytes(rng, text.encode())
    commands = [["check", "scenario.yaml"]]
    files = {"scenario.yaml": SCENARIO, "robot.urdf": data}
    if rng.random() < 0.3:
        files |= OLD
        commands.append(
            [
                "run",
                "scenario.yaml",
                "--no-figures",
                "--quiet",
                "--out",
                "out",
                *(word for text in SHORT for word in ("--set", text)),
            ]
        )
    return Draft(mutation, files, commands, losses)


def _mutate(rng: Random, root: ElementTree.Element) -> str:
    """Damage one element, usually one that physics depends on."""
    parents = {child: parent for parent in root.iter() for child in parent}
    physical = [
        element
        for element in parents
        if element.tag not in ("visual", "collision", "geometry", "material", "color", "cylinder")
    ]
    if not physical:
        return "nothing left"
    element = rng.choice(physical if rng.random() < 0.9 else list(parents))
    where = f"<{element.tag} {' '.join(f'{key}={text}' for key, text in element.items())}>"
    choice = rng.random()
    if choice < 0.45 and element.attrib:
        key = rng.choice(list(element.attrib))
        old = element.get(key, "")
        if key in ("name", "link"):
            new = rng.choice((*NAMES, old + "x", old.upper()))
        elif key == "type":
            new = rng.choice(TYPES)
        else:
            words = old.split()
            index = rng.randrange(max(1, len(words)))
            near = _near(rng, words[index]) if words else ""
            changed = [*words[:index], rng.choice((rng.choice(NUMBERS), near)), *words[index + 1 :]]
            new = rng.choice((" ".join(changed), " ".join(changed), rng.choice(NUMBERS), f"{old} 1"))
        element.set(key, new)
        return f"{where}: {key}={new[:40]!r}"
    if choice < 0.55 and element.attrib:
        key = rng.choice(list(element.attrib))
        text = element.attrib.pop(key)
        if rng.random() < 0.5:
            element.set(rng.choice((key + "x", key.upper(), "value", "{http://x}" + key)), text)
        return f"{where}: without {key}"
    parent = parents[element]
    if choice < 0.72:
        parent.remove(element)
        return f"without {where}"
    if choice < 0.8:
        parent.insert(rng.randrange(len(parent) + 1), copy.deepcopy(element))
        return f"{where} twice"
    if choice < 0.87:
        target = rng.choice([other for other in root.iter() if other is not element and other not in element.iter()])
        parent.remove(element)
        target.append(element)
        return f"{where} moved into <{target.tag}>"
    if choice < 0.94:
        element.tag = rng.choice(TAGS)
        return f"{where} is now <{element.tag}>"
    extra = ElementTree.SubElement(
        element, rng.choice(TAGS), {"joint": "base_yaw", "value": rng.choice(NUMBERS), "multiplier": "2"}
    )
    return f"<{extra.tag}> in {where}"


def _near(rng: Random, word: str) -> str:
    try:
        number = float(word)
    except ValueError:
        return word + "0"
    return repr(rng.choice((number * 1.5, -number, number + 0.1, number * 1e6, number * 1e-6)))


def losses() -> list[str]:
    """Return losses between robot.urdf and the model."""
    from dynsim.scenario import build_model, load_scenario

    model = build_model(load_scenario("scenario.yaml"))
    return urdf_losses(Path("robot.urdf").read_bytes(), model.robot)
