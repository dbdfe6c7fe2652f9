"""Inputs parsed without dynsim and compared with dynsim's objects.

Every function returns the losses as lines of text, an empty list if there are none. An input that the second reader
cannot read counts as no loss.
"""

from __future__ import annotations

import io
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

# ASCII digits only, no underscores: other texts that float() accepts are not numbers in other programs.
DECIMAL = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
# Keys whose values dynsim rewrites: absolute paths, and folder names derived from the name of the file.
_REWRITTEN = frozenset({"file", "name", "variant"})
# Texts that are certainly true or false as a flag.
_TRUE, _FALSE = ("true", "1", "1.0", "yes", "on", "y", "t"), ("false", "0", "0.0", "-0.0", "no", "off", "n", "f")
ROUNDING = 1e-9


class Unreadable(Exception):
    """Raised if the second reading gives no answer."""


@lru_cache(1)
def _loaded(path: Path, written: int) -> Any:
    from dynsim.record import Record

    return Record.load(path)


def loaded(path: Path) -> Any:
    """Return a record; the last one is kept, because several checks read it."""
    return _loaded(path.absolute(), path.stat().st_mtime_ns)


def yaml_tree(text: str) -> Any:
    """Return a YAML text as plain values, by ruamel's safe reader; dynsim uses the reader that keeps lines."""
    from ruamel.yaml import YAML

    if len(text) > 200_000:
        raise Unreadable("too long for that reader, which takes a minute for a megabyte")
    try:
        return YAML(typ="safe", pure=True).load(io.StringIO(text))
    except Exception as error:  # any error means that this reader gives no answer
        raise Unreadable(str(error)) from error


def merged(base: Any, difference: Any) -> Any:
    """Merge ``difference`` over ``base`` as in docs: mappings merge, lists and values replace, null removes."""
    if not isinstance(difference, Mapping):
        return difference
    out = dict(base) if isinstance(base, Mapping) else {}
    for key, item in difference.items():
        if item is None:
            out.pop(key, None)
        else:
            out[key] = merged(out.get(key), item)
    return out


def set_dotted(tree: Any, dotted: str, item: Any) -> None:
    """Set ``a.b.0.c`` in a tree; raise :class:`Unreadable` if the path does not exist."""
    *path, last = dotted.split(".")
    node = tree
    try:
        for key in path:
            if isinstance(node, list):
                node = node[int(key)]
            else:
                key = _key(node, key)
                if node.get(key) is None:
                    node[key] = {}
                node = node[key]
        node[int(last) if isinstance(node, list) else _key(node, last)] = item
    except (LookupError, ValueError, AttributeError, TypeError) as error:
        raise Unreadable(dotted) from error


def _key(node: Mapping[Any, Any], text: str) -> Any:
    """Return the key that is written like ``text``, which this reader may have converted to a number."""
    return next((key for key in node if str(key) == text), text)


def missing(said: Any, taken: Any, where: str = "") -> list[str]:
    """Return values of ``said`` that are not in ``taken``; ``taken`` may contain more (defaults)."""
    if isinstance(said, Mapping):
        if not said:
            return []
        if not isinstance(taken, Mapping):
            return [f"{where}: a mapping became {taken!r}"]
        lost = []
        for key, item in said.items():
            # Keys are text as written; this reader may have converted it to a number or a date.
            if item is None or key in _REWRITTEN or not isinstance(key, str):
                continue
            inner = f"{where}.{key}".lstrip(".")
            if key not in taken:
                lost.append(f"{inner} = {item!r} is gone")
            else:
                lost += missing(item, taken[key], inner)
        return lost
    if isinstance(said, (list, tuple)):
        if not isinstance(taken, (list, tuple)) or len(said) != len(taken):
            return [f"{where}: {len(said)} entries became {str(taken)[:60]}"]
        return [
            line for k, (a, b) in enumerate(zip(said, taken, strict=True)) for line in missing(a, b, f"{where}.{k}")
        ]
    return (
        []
        if _same(said, taken)
        else [f"{where}: {str(said)[:60]!r} ({type(said).__name__}) was taken for {str(taken)[:60]!r}"]
    )


def _same(said: Any, taken: Any) -> bool:
    if isinstance(taken, bool):
        return str(said).lower() in (_TRUE if taken else _FALSE)
    if isinstance(said, bool):
        return isinstance(taken, str)
    if isinstance(taken, (int, float)):
        if isinstance(said, str):
            return DECIMAL.fullmatch(said.strip()) is not None and float(said) == taken
        # Digits beyond the precision of a double are rounded, in integers as in decimal numbers.
        return said == taken or (isinstance(said, int) and isinstance(taken, float) and float(said) == taken)
    # This reader converts dates, sets etc., which are text as written in dynsim.
    return said == taken or (isinstance(taken, str) and not isinstance(said, str))


def scenario_losses(said: Mapping[str, Any], scenario: Any) -> list[str]:
    """Return values of a merged scenario that the validated one lacks, and masses and friction that the model lacks."""
    said = {key: item for key, item in said.items() if key not in ("variants", *_REWRITTEN)}
    taken = scenario.resolved
    plant = dict(said["plant"]) if isinstance(said.get("plant"), Mapping) else {}
    if isinstance(plant.get("arm"), Mapping):
        plant["arm"] = _unshared(plant["arm"])
    plant = _unshared(plant)
    if plant:
        said["plant"] = plant
    return missing(said, taken) + _model_losses(said, plant, scenario)


def _unshared(plant: Mapping[str, Any]) -> dict[str, Any]:
    """Return an arm as in the resolved scenario: without a shared link, whose keys every entry of the chain has."""
    plant = dict(plant)
    if plant.get("type") == "serial_arm" and isinstance(plant.get("chain"), list):
        shared = plant.pop("link", None) or {}
        plant["chain"] = [_with_shared(shared, entry) for entry in plant["chain"]]
    return plant


def _with_shared(shared: Mapping[str, Any], entry: Any) -> Any:
    if not isinstance(entry, Mapping):
        return entry
    foreign = {"prismatic": ("damping_N_m_s_per_rad", "initial_deg")}.get(
        entry.get("kind", shared.get("kind")), ("damping_N_s_per_m", "initial_m")
    )
    return {**{key: item for key, item in shared.items() if key not in foreign}, **entry}


def _model_losses(said: Mapping[str, Any], plant: Mapping[str, Any], scenario: Any) -> list[str]:
    lost: list[str] = []
    if scenario.engine != "dynamics":
        return lost
    from dynsim.scenario import build

    if plant.get("type") == "serial_arm" and not said.get("loads") and not said.get("objects"):
        masses = [
            float(entry.get("mass_kg", 0.1)) for entry in plant["chain"] for _ in range(int(entry.get("count", 1)))
        ]
        built = [link.inertia.mass for link in build.robot(scenario).links]
        if masses != built:
            lost.append(f"masses {masses[:5]}… became {built[:5]}…")
    contacts = said.get("contacts") or {}
    points = contacts.get("points") or {}
    factor = float((said.get("surface_error") or {}).get("friction_factor", 1.0))
    friction = {
        str(name): factor
        * float(point["friction"] if point.get("friction") is not None else contacts.get("friction", 0.1))
        for name, point in points.items()
        if point is not None and point.get("enabled", True)
    }
    held = {contact.name: contact.friction for contact in build.contacts(scenario)}
    # Candidates, objects and wheels are points that the file does not list.
    if contacts.get("candidates", "points") != "points" or said.get("objects") or plant.get("type") == "snake":
        held = {name: held[name] for name in friction if name in held}
    if friction != held:
        lost.append(f"friction {friction} became {held}")
    return lost


def servo_map_losses(said: Mapping[str, Any], servo_map: Any) -> list[str]:
    """Return entries of a servo map that its servos, bus and safety rules lack."""
    lost = missing(said.get("bus") or {}, servo_map.bus.model_dump(), "bus")
    lost += missing(said.get("safety") or {}, servo_map.safety.model_dump(), "safety")
    entries = list(said["servos"].items())
    kinds = {str(name): kind for name, kind in said["kinds"].items()}
    if len(entries) != len(servo_map.servos):
        return [*lost, f"{len(entries)} servos became {len(servo_map.servos)}"]
    for servo, (joint, entry) in zip(servo_map.servos, entries, strict=True):
        # A key is text as written; this reader may have converted it to a number or a date.
        if isinstance(joint, str) and joint != servo.joint:
            lost.append(f"servos.{joint} became {servo.joint}")
        taken = {"id": servo.id, "sign": servo.sign, "zero_tick": servo.zero_tick, "label": servo.label}
        lost += missing({key: item for key, item in entry.items() if key in taken}, taken, f"servos.{servo.joint}")
        hold_at = entry.get("hold_at_deg")
        if hold_at is not None and not math.isclose(hold_at, math.degrees(servo.hold_at), rel_tol=ROUNDING):
            lost.append(f"servos.{servo.joint}.hold_at_deg = {hold_at} became {math.degrees(servo.hold_at)}")
        lost += missing(kinds.get(str(entry["kind"]), {}), servo.kind.model_dump(), f"kinds.{entry['kind']}")
    return lost


def csv_rows(data: bytes) -> list[list[float]]:
    """Return the rows of a path table, each number in decimal digits; otherwise raise :class:`Unreadable`."""
    try:
        lines = data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n").split("\n")
    except UnicodeDecodeError as error:
        raise Unreadable("not UTF-8") from error
    rows = []
    for line in lines[1:]:
        if line := line.partition("#")[0].strip(" \t"):
            cells = [cell.strip(" \t") for cell in line.split(",")]
            if len(cells) != 4 or not all(DECIMAL.fullmatch(cell) for cell in cells):
                raise Unreadable(line)
            rows.append([float(cell) for cell in cells])
    return rows


def urdf_losses(data: bytes, robot: Any) -> list[str]:
    """Return masses, inertias, joints and damping of a URDF file that a robot lacks; fixed links are combined."""
    # Without namespaces, which URDF readers ignore: existing files have prefixes that they do not bind.
    tree, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = tree.start, tree.end, tree.data
    try:
        parser.Parse(data, True)
        return _urdf_differences(tree.close(), robot)
    except (Unreadable, expat.ExpatError) as error:
        return [f"a strict reading refuses the file: {error}"]


def _urdf_differences(root: ElementTree.Element, robot: Any) -> list[str]:
    links = {link.get("name"): _body(link) for link in root.findall("link")}
    joints = root.findall("joint")
    moving = {"revolute", "continuous", "prismatic"}
    lost = []
    named = {str(joint.get("name")) for joint in joints if joint.get("type") in moving}
    locked = named - set(robot.joint_names)
    if locked or len(named) != len(robot.links):
        lost.append(f"joints {sorted(named)} became {sorted(robot.joint_names)}")
    below: dict[str | None, list[ElementTree.Element]] = {}
    for joint in joints:
        if joint.get("type") == "fixed":
            below.setdefault(joint.find("parent").get("link"), []).append(joint)

    def composite(name: str | None) -> np.ndarray:
        total = links[name]
        for joint in below.get(name, ()):
            total = total + _moved(composite(joint.find("child").get("link")), joint.find("origin"))
        return total

    child_of = {joint.get("name"): joint.find("child").get("link") for joint in joints}
    damping_of = {joint.get("name"): joint.find("dynamics") for joint in joints}
    for link in robot.links:
        if link.joint not in child_of:
            lost.append(f"joint {link.joint!r} is not in the file")
            continue
        said, taken = (
            composite(child_of[link.joint]),
            _pseudo_inertia(link.inertia.mass, link.inertia.com, link.inertia.tensor),
        )
        scale = np.abs(said).max()
        if not np.allclose(said, taken, rtol=ROUNDING, atol=ROUNDING * max(scale, 1e-300)):
            far = np.abs(said - taken).max()
            lost.append(
                f"body {link.name!r}: mass and moments differ ({said[3, 3]:.9g}, {taken[3, 3]:.9g} kg; {far:.3g})"
            )
        element = damping_of[link.joint]
        damping = 0.0 if element is None else _number(element.get("damping", "0"))
        if damping != link.damping:
            lost.append(f"joint {link.joint!r}: damping {damping} became {link.damping}")
    return lost


def _number(text: str | None) -> float:
    if text is None or not DECIMAL.fullmatch(text.strip(" \t\r\n")):
        raise Unreadable(f"{text!r} is not a number")
    return float(text)


def _numbers(text: str) -> np.ndarray:
    return np.array([_number(word) for word in text.split()])


def _body(link: ElementTree.Element) -> np.ndarray:
    """Return the pseudo-inertia of a link about its own frame, (4, 4); zero without <inertial>."""
    name = link.get("name")
    inertials = link.findall("inertial")
    if not inertials:
        return np.zeros((4, 4))
    masses, inertias = inertials[0].findall("mass"), inertials[0].findall("inertia")
    if len(inertials) != 1 or len(masses) != 1 or len(inertias) != 1:
        raise Unreadable(
            f"link {name!r} has {len(inertials)} <inertial>, {len(masses)} <mass>, {len(inertias)} <inertia>"
        )
    xx, xy, xz, yy, yz, zz = (_number(inertias[0].get(key)) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return _moved(_pseudo_inertia(_number(masses[0].get("value")), np.zeros(3), tensor), inertials[0].find("origin"))


def _pseudo_inertia(mass: float, com: np.ndarray, tensor: np.ndarray) -> np.ndarray:
    """Return [[Σ, m c], [m cᵀ, m]], Σ = ∫ r rᵀ dm = ½ tr(I) 1 − I about the frame; it transforms as T J Tᵀ."""
    J = np.empty((4, 4))
    J[:3, :3] = 0.5 * np.trace(tensor) * np.eye(3) - tensor + mass * np.outer(com, com)
    J[:3, 3] = J[3, :3] = mass * np.asarray(com)
    J[3, 3] = mass
    return J


def _moved(J: np.ndarray, origin: ElementTree.Element | None) -> np.ndarray:
    """Return a pseudo-inertia in the frame in which ``origin`` places it."""
    if origin is None:
        return J
    T = np.eye(4)
    xyz, rpy = _numbers(origin.get("xyz", "0 0 0")), _numbers(origin.get("rpy", "0 0 0"))
    if len(xyz) != 3 or len(rpy) != 3:
        raise Unreadable(f"<origin {dict(origin.items())}> is not of three numbers each")
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    T[:3, :3] = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )
    T[:3, 3] = xyz
    return T @ J @ T.T


def record_losses(sound: Any, loaded: Any) -> list[str]:
    """Return signals, units, labels, summary and provenance of a valid record that a loaded record lacks."""
    lost = []
    if not np.array_equal(sound.time, loaded.time):
        lost.append("time changed")
    for name, signal in sound.signals.items():
        if name not in loaded:
            lost.append(f"signal {name!r} is gone")
        elif not np.array_equal(signal.data, loaded[name], equal_nan=signal.data.dtype.kind == "f"):
            lost.append(f"signal {name!r} changed")
        elif (signal.unit, signal.labels) != (loaded.units[name], loaded.labels[name]):
            lost.append(f"unit or labels of {name!r} changed: {loaded.units[name]!r} {loaded.labels[name]}")
        elif not np.array_equal(sound.times(name), loaded.times(name)):
            lost.append(f"instants of {name!r} changed")
    for name in ("summary", "provenance", "complete", "events", "scene"):
        if getattr(sound, name) != getattr(loaded, name):
            lost.append(f"{name} changed")
    return lost
