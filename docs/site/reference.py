"""Generated text of the reference: keys of files from their schemas, commands from the application."""

from __future__ import annotations

import re
from typing import Any

Schema = dict[str, Any]

SERVO_MAP_INTRODUCTION = """# Keys of servo maps

Every key that a servo map may have, from the schema that it is checked with. What the keys mean together, with
an example, is in [Servo map](../hardware/servo-map.md). `dynsim hw schema` prints the schema for editors.

"""


# Titles of definitions whose names are short because their keys are clear from their place in a scenario.
TITLES = {
    "Base": "Base of pws_arm",
    "BaseConfig": "Base of serial_arm",
    "WheelConfig": "Wheel of pws_arm",
    "LinkConfig": "Entry of chain",
    "LinkKeys": "Default of chain",
    "Constant": "Load constant",
    "Samples": "Load samples",
    "Table": "Load csv",
    "Payload": "Load payload",
    "Linear": "Tie linear",
    "Torsion": "Tie torsion",
    "SceneObject": "Object",
    "Part": "Object part",
    "Hinge": "Object hinge",
    "Slide": "Object slide",
    "Grasp": "Object grasp",
    "OperatorConfig": "Operator",
    "Velocity": "Operator command",
    "Dynamics": "Snake dynamics",
    "Lifting": "Snake lifting",
    "Switching": "Snake switching",
    "Ramp": "Snake path ramp",
    "Circle": "Snake path circle",
    "DoorArc": "Snake path door_arc",
    "GripperConfig": "Snake gripper",
    "JointLimits": "Snake limits",
    "JointStops": "Snake stops",
}
CATALOGUE = "Motor catalogue"


def scenario_keys() -> str:
    """Return a section of keys for each mapping of a scenario."""
    from dynsim.scenario import ScenarioConfig

    return f"\n{_sections(ScenarioConfig.model_json_schema())}\n"


def servo_map_page() -> str:
    """Return the page on the keys of servo maps."""
    from dynsim.hardware.servo_map import json_schema

    return SERVO_MAP_INTRODUCTION + _sections(json_schema())


def _sections(schema: Schema) -> str:
    definitions = schema["$defs"]
    named = {name: _title(name) for name in definitions}
    parts = ["## Top level\n\n", _keys(schema, named)]
    for name, title in sorted(named.items(), key=lambda item: item[1].lower()):
        if title != CATALOGUE:
            text = _plain(definitions[name].get("description", ""))
            parts += [f"\n## {title}\n\n", text, "\n\n", _keys(definitions[name], named)]
    if CATALOGUE in named.values():
        servo = next(definitions[name] for name, title in named.items() if title == "Motor servo")
        parts.append(_catalogue(servo, [definitions[name] for name in named if named[name] == CATALOGUE]))
    return "".join(parts)


def _catalogue(servo: Schema, motors: list[Schema]) -> str:
    """Return the values of the motors that differ from the defaults of a servo, one row per motor."""
    values = [{key: value for key, value in motor["properties"].items() if key != "type"} for motor in motors]
    keys = [key for key in values[0] if any(_value(row[key]) != _value(servo["properties"][key]) for row in values)]
    rows = [
        f"\n## {CATALOGUE}\n\nServos with the values of data sheets, and the other defaults of a servo. "
        "\\*: assumed. †: fitted to a robot.\n",
        f"| type | robot | {' | '.join(f'`{key}`' for key in keys)} | source |",
        f"|---|---{'|---:' * len(keys)}|---|",
    ]
    for motor, row in zip(motors, values, strict=True):
        texts = " ".join(value.get("description", "") for value in row.values())
        sources = " ".join(f"[page]({url})" for url in dict.fromkeys(re.findall(r"https?://[^\s,;)]+", texts)))
        cells = " | ".join(_value(row[key]) for key in keys)
        name = motor["properties"]["type"]["const"]
        robot = re.sub(r"^.*: | with its rated values|\.$", "", _plain(motor["description"]))
        rows.append(f"| `{name}` | {robot} | {cells} | {sources} |")
    return "\n".join(rows) + "\n"


def _value(value: Schema) -> str:
    text = value.get("description", "")
    mark = r" \*" if "(assumed)" in text else " †" if "fitted" in text else ""
    default = value.get("default")
    return "–" if default is None else f"{default:g}{mark}" if isinstance(default, float) else f"`{default}`{mark}"


def _title(name: str) -> str:
    """Return the heading of a definition; for a member, its family and type."""
    from dynsim.library.motors import catalogue

    member = re.fullmatch(r"dynsim__library__(\w+?)__(\w+)__Config", name)
    if member:
        return f"{member[1].replace('_', ' ').rstrip('s').capitalize()} {member[2]}"
    if name in catalogue.NAMES:
        return CATALOGUE
    return TITLES.get(name) or re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).capitalize()


def _keys(schema: Schema, named: dict[str, str]) -> str:
    """Return the table of the keys of an object, or the type of a definition that is not an object."""
    if "properties" not in schema:
        return f"{_kind(schema, named)}\n"
    required = schema.get("required", ())
    rows = ["| key | type | default | meaning |", "|---|---|---|---|"]
    for key, value in schema["properties"].items():
        default = "required" if key in required else _default(value)
        meaning = _plain(value.get("description", "")).replace("\n", " ")
        rows.append(f"| `{key}` | {_kind(value, named)} | {default} | {meaning} |")
    return "\n".join(rows) + "\n"


def _default(value: Schema) -> str:
    if "default" not in value:
        return ""
    default = value["default"]
    words = {None: "none", True: "`true`", False: "`false`", "": "empty"}
    if isinstance(default, dict) and "$ref" in value:
        return "see its keys"
    if isinstance(default, (dict, list)):
        return f"`{default}`" if default else "none"
    return (
        words[default] if default is None or (isinstance(default, (bool, str)) and default in words) else f"`{default}`"
    )


def _kind(value: Schema, named: dict[str, str]) -> str:
    """Return type and bounds of a value, with links to definitions."""
    if "$ref" in value:
        title = named[value["$ref"].rsplit("/", 1)[1]]
        return f"[{title}](#{title.lower().replace(' ', '-')})"
    choices = value.get("oneOf") or value.get("anyOf")
    if choices:
        return " or ".join(dict.fromkeys(_kind(choice, named) for choice in choices))
    if "const" in value:
        return f"`{value['const']}`"
    if "enum" in value:
        return ", ".join(f"`{choice}`" for choice in value["enum"])
    kind = value.get("type", "any")
    if kind == "array":
        items = [_kind(item, named) for item in value.get("prefixItems", [value.get("items", {})])]
        size = value.get("minItems") if value.get("minItems") == value.get("maxItems") else None
        return f"{size} × {items[0]}" if size else f"list of {' or '.join(dict.fromkeys(items))}"
    if kind == "object":
        inner = value.get("additionalProperties")
        return f"mapping to {_kind(inner, named)}" if isinstance(inner, dict) else "mapping"
    bounds = [
        f"{sign} {value[key]}"
        for key, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<"))
        if key in value
    ]
    words = {"number": "number", "integer": "integer", "string": "text", "boolean": "`true`, `false`", "null": "none"}
    return " ".join([words.get(kind, str(kind)), *bounds])


def _plain(text: str) -> str:
    """Return the text of a docstring without the roles of its markup, safe in a table."""
    return without_roles(text).replace("|", "\\|").strip()


def without_roles(text: str) -> str:
    """Convert ``:class:`~a.b.C``` to `C`, and double backticks to single ones."""
    text = re.sub(r":\w+:`~?(?:[\w.]+\.)?([\w ]+)`", r"`\1`", text)
    return text.replace("``", "`")


def cli_page() -> str:
    """Return the page on the commands, as Typer describes them."""
    import typer
    from typer.cli import get_docs_for_click

    from dynsim.cli.commands import app

    command = typer.main.get_command(app)
    context = command.context_class(command, info_name="dynsim")
    text = get_docs_for_click(obj=command, ctx=context, name="dynsim", title="Commands")
    # Angle brackets outside of code would be tags.
    return re.sub(r"^Example: (.*)$", r"Example: `\1`", text, flags=re.MULTILINE)
