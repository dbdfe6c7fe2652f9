"""Names, symbols and units of scenario keys, derived from their descriptions and from the names of their parts."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel

from dynsim.record.quantities import Quantity, unit_of
from dynsim.scenario.schema import Scenario, ScenarioConfig

# Names for keys whose descriptions and words are unsuitable as names.
_NAMES = {
    "atol": "absolute tolerance", "center": "centre", "com": "centre of mass", "coulomb_friction": "Coulomb friction",
    "count": "number of links", "edge_radius": "edge radius", "edges": "edge length",
    "friction": "coefficient of friction", "inertia": "moment of inertia", "k_d": "rate gain", "k_p": "position gain",
    "k_v": "velocity gain", "limit": "limit", "limits": "limit", "min": "minimum force of the braces",
    "point": "position", "rtol": "relative tolerance", "size": "edge length",
    "slip_smoothing": "smoothing speed of slip", "static_friction": "static coefficient of friction",
    "stribeck": "Stribeck speed",
}  # fmt: skip
# First words of names that end with "angle" or "position", depending on the unit.
_PLACED = {"initial": "initial", "lock": "locked", "rest": "rest"}
_SYMBOLS = {"friction": "μ", "static_friction": "μ_s", "k_p": "k_p", "k_d": "k_d", "k_v": "k_v", "stribeck": "v_s"}
# Components of vectors that are not x, y, z; keys whose third component is a height; keys of lists of equal entries.
_COMPONENTS = {
    "rpy": ("roll", "pitch", "yaw"), "inertia": ("xx", "xy", "xz", "yy", "yz", "zz"), "limit": ("lower", "upper"),
}  # fmt: skip
_POSITIONS = ("center", "point", "position", "origin", "shift")
_LISTS = ("times", "angles", "positions", "torques", "points", "initial", "k_p", "k_d", "gain")
# Sections with named or numbered entries, and sections that own no quantity.
_NAMED = (
    "surfaces", "points", "loads", "objects", "ties", "joints", "links", "parts", "wheels", "wrench", "motors",
    "torques", "initial_pose", "commands", "paths",
)  # fmt: skip
_GENERAL = (
    "plant", "arm", "controller", "contacts", "integrator", "record", "metrics", "motor", "link", "surface_error",
    "mass_error", "requirements",
)  # fmt: skip
# Keys of an entry of a chain that belong to the link; all others belong to the joint.
_OF_LINK = ("length", "radius", "mass", "com", "inertia", "count")
# Words that start the specification of a quantity after its name.
_SPECIFICATION = re.compile(
    r" (?:of|in|at|on|to|for|about|along|across|between|from|that|as|when|towards|without|ahead|beyond) "
)
# Symbols in a description: letters with an optional index, except words and coordinates.
_SYMBOL = re.compile(r" (?![axyz]\b)[A-Za-zμθ](?:_\w{1,3})?(?= |$)")
# Maximum length of a name from a description [characters]; a longer one is replaced by the words of the key.
_LENGTH = 48


def quantity(key: str, scenario: Scenario | ScenarioConfig | None = None) -> Quantity:
    """Return name, symbol and unit of a scenario key.

    Parameters
    ----------
    key : str
        Dotted key, e.g. ``"plant.chain.3.initial_deg"``.
    scenario : Scenario or ScenarioConfig, optional
        Scenario in which the key occurs; its schema describes the key. Without it, the name consists of the key's own
        words.

    Returns
    -------
    Quantity
        The quantity; its ``name`` includes the part to which it belongs.

    Examples
    --------
    >>> import dynsim
    >>> scenario = dynsim.load_scenario("elbow_comparison", variant="two_elbows")
    >>> quantity("surfaces.floor.point_m.2", scenario).label
    'height of floor [m]'
    >>> quantity("contacts.friction", scenario)
    Quantity(name='coefficient of friction', symbol='μ', unit='', scale=1.0)
    """
    parts = key.split(".")
    indices: list[str] = []
    while len(parts) > 1 and _is_index(parts[-1]):
        indices.insert(0, parts.pop())
    # In mappings of numbers, such as initial_deg.shoulder, the last part is the name of a joint.
    entry = parts.pop() if len(parts) > 1 and unit_of(parts[-2])[1] else ""
    *sections, last = parts
    config = scenario.config if isinstance(scenario, Scenario) else scenario
    text = _description(config, sections, last)
    words, unit = unit_of(last)
    unit = unit or _bracketed(text)
    described = "" if "motor" in sections else _head(text)
    if words == "friction" and unit:
        words = "dry_friction"
    of_motor = sections[-1:] == ["motor"]
    owner = entry or _owner(sections, config, "link" if words in _OF_LINK and not of_motor else "joint")
    if words in _PLACED:
        described = f"{_PLACED[words]} {'position' if unit == 'm' else 'angle'}"
        if indices and not owner:
            index = indices.pop(0)
            owner = "all joints" if index == "*" else f"joint {int(index) + 1}"
    components = [_component(words, index, inner=k > 0) for k, index in enumerate(indices)]
    name = _NAMES.get(words) or (_SPECIFICATION.split(described)[0] if owner else described) or words.replace("_", " ")
    if components == ["z"] and words in _POSITIONS and _in_world(sections):
        name, components = "height error of the surfaces" if words == "shift" else "height", []
        # A solid extends above its centre or axis.
        part = "centre" if words == "center" else "axis" if " the axis" in text else ""
        owner = f"{owner or f'the {sections[-1]}'}'s {part}" if part else owner
    if words == "mass" and of_motor:
        name = "motor mass"
    if owner:
        name = f"{name} of {owner}"
    elif sections and sections[-1] not in _GENERAL and not _SPECIFICATION.search(name):
        name = f"{name} of the {sections[-1].replace('_', ' ')}"
    return Quantity(", ".join([name, *components]), _SYMBOLS.get(words, ""), unit)


def _in_world(sections: Sequence[str]) -> bool:
    """Return whether positions in a section are in the axes of the world."""
    outer, inner = sections[:1], sections[-1:]
    return outer in (["surfaces"], ["surface_error"]) or inner in (["base"], ["path"]) or sections[:-1] == ["objects"]


def _is_index(part: str) -> bool:
    return part.isdecimal() or part == "*"


def _description(config: ScenarioConfig | None, sections: Sequence[str], key: str) -> str:
    """Return the description of a key; "" if the configuration does not have it."""
    model = _part(config, sections)
    field = type(model).model_fields.get(key) if isinstance(model, BaseModel) else None
    return "" if field is None else field.description or ""


def _part(config: ScenarioConfig | None, sections: Sequence[str]) -> Any:
    """Return the part of the configuration at the end of a path; None if the path leads nowhere."""
    node: Any = config
    for section in sections:
        if isinstance(node, (Mapping, list)):
            entries = node if isinstance(node, Mapping) else dict(zip(map(str, range(len(node))), node, strict=True))
            node = entries.get(section) if section != "*" else next(iter(entries.values()), None)
        else:
            node = getattr(node, section, None)
    return node


def _head(text: str) -> str:
    """Return the name at the start of a description; "" if it is too long, or a formula."""
    head = _SYMBOL.sub("", re.split(r"[;:(,\[]", text)[0].strip()).removesuffix(" in the world")
    return head if len(head) <= _LENGTH and not re.search(r"[_`√+=]| of$", head) else ""


def _bracketed(text: str) -> str:
    """Return the unit in brackets in a description, for keys without a unit; "" without brackets."""
    match = re.search(r"\[((?:1/)?(?:deg|rad|m|s|N)\b[^\],]*)[\],]", text)
    return match[1].replace("deg", "°") if match else ""


def _owner(sections: Sequence[str], config: ScenarioConfig | None, kind: str) -> str:
    """Return the innermost named entry, e.g. a surface, a contact, or a joint or link (``kind``); "" if none."""
    for k in range(len(sections) - 1, 0, -1):
        section, name = sections[k - 1 : k + 1]
        if section == "chain" and _is_index(name):
            return _numbered(name, kind, _part(config, sections[:k]))
        if section in _NAMED:
            return f"all {section}" if name == "*" else f"{section[:-1]} {name}" if name.isdecimal() else name
    return ""


def _numbered(index: str, kind: str, chain: Any) -> str:
    """Return the numbers of the joints or links of an entry of a chain, as in their names: joint 4, links 2 to 5."""
    counts = [getattr(link, "count", 1) for link in chain] if isinstance(chain, list) else []
    if index == "*" or int(index) >= len(counts):
        return f"all {kind}s" if index == "*" else f"entry {index} of the chain"
    first, count = 1 + sum(counts[: int(index)]), counts[int(index)]
    return f"{kind} {first}" if count == 1 else f"{kind}s {first} to {first + count - 1}"


def _component(words: str, index: str, inner: bool) -> str:
    """Return the name of a component of a vector; in lists, unless of vectors (``inner``), the number of the entry."""
    names = next((names for key, names in _COMPONENTS.items() if words.startswith(key)), ("x", "y", "z"))
    if index == "*":
        return "all"
    return names[int(index)] if int(index) < len(names) and (inner or words not in _LISTS) else f"no. {int(index) + 1}"
