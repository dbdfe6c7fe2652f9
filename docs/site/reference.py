"""Generated pages of the reference: keys of files from their schemas, commands from the application."""

from __future__ import annotations

import re
from typing import Any

Schema = dict[str, Any]

SCENARIO_INTRODUCTION = """# Keys of scenarios

Every key that a scenario file may have, from the schema that it is checked with. What the keys mean together, with
examples, is in [Scenarios](../scenarios.md). `dynsim schema` prints the schema for editors.

"""

SERVO_MAP_INTRODUCTION = """# Keys of servo maps

Every key that a servo map may have, from the schema that it is checked with. What the keys mean together, with
an example, is in [Replaying a record on Dynamixel servos](../hardware.md#the-servo-map). `dynsim hw schema` prints
the schema for editors.

"""


def scenario_page() -> str:
    """Return the page on the keys of scenarios."""
    from dynsim.scenario import ScenarioConfig

    return _page(SCENARIO_INTRODUCTION, ScenarioConfig.model_json_schema())


def servo_map_page() -> str:
    """Return the page on the keys of servo maps."""
    from dynsim.hardware.servo_map import json_schema

    return _page(SERVO_MAP_INTRODUCTION, json_schema())


def _page(introduction: str, schema: Schema) -> str:
    named = {name: _title(name) for name in schema["$defs"]}
    parts = [introduction, "## Top level\n\n", _keys(schema, named)]
    for name, definition in sorted(schema["$defs"].items(), key=lambda item: named[item[0]].lower()):
        parts += [
            f"\n## {named[name]}\n\n",
            _plain(definition.get("description", "")),
            "\n\n",
            _keys(definition, named),
        ]
    return "".join(parts)


def _title(name: str) -> str:
    """Return the heading of a definition; for a member, its family and type."""
    from dynsim.library.motors import catalogue

    member = re.fullmatch(r"dynsim__library__(\w+?)__(\w+)__Config", name)
    if member:
        return f"{member[1].replace('_', ' ').rstrip('s').capitalize()} {member[2]}"
    if name in catalogue.NAMES:
        return f"Motor {name}"
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).capitalize()


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
        return "of its keys"
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
        return f"by name: {_kind(inner, named)}" if isinstance(inner, dict) else "mapping"
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
