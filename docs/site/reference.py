"""Pages of the reference that are generated: keys of scenarios from their schema, commands from the application."""

from __future__ import annotations

import re
from typing import Any

Schema = dict[str, Any]

SCENARIO_INTRODUCTION = """# Keys of scenarios

Every key that a scenario file may have, from the schema that it is checked with. What the keys mean together, with
examples, is in [Scenarios](../scenarios.md). `dynsim schema` prints the schema for editors.

"""
CLI_INTRODUCTION = """# Commands

Every command with its options, as `--help` shows them.

"""


def scenario_page() -> str:
    """The page on the keys of scenarios."""
    from dynsim.scenario import ScenarioConfig

    schema = ScenarioConfig.model_json_schema()
    named = {name: _title(name) for name in schema["$defs"]}
    parts = [SCENARIO_INTRODUCTION, "## Top level\n\n", _keys(schema, named)]
    for name, definition in sorted(schema["$defs"].items(), key=lambda item: named[item[0]].lower()):
        parts += [
            f"\n## {named[name]}\n\n",
            _plain(definition.get("description", "")),
            "\n\n",
            _keys(definition, named),
        ]
    return "".join(parts)


def _title(name: str) -> str:
    """Heading of a definition: that of a member is its family and type."""
    member = re.fullmatch(r"dynsim__library__(\w+?)__(\w+)__Config", name)
    if member:
        return f"{member[1].replace('_', ' ').rstrip('s').capitalize()} {member[2]}"
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).capitalize()


def _keys(schema: Schema, named: dict[str, str]) -> str:
    """The table of an object's keys; what a definition is that is no object."""
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
    if isinstance(default, (dict, list)):
        return f"`{default}`" if default else "none"
    return (
        words[default] if default is None or (isinstance(default, (bool, str)) and default in words) else f"`{default}`"
    )


def _kind(value: Schema, named: dict[str, str]) -> str:
    """Type and bounds of a value, with links to definitions."""
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
    """Text of a docstring without the roles of its markup, safe in a table."""
    return without_roles(text).replace("|", "\\|").strip()


def without_roles(text: str) -> str:
    """``:class:`~a.b.C``` as `C`, and double backticks as single ones."""
    text = re.sub(r":\w+:`~?(?:[\w.]+\.)?([\w ]+)`", r"`\1`", text)
    return text.replace("``", "`")


def cli_page() -> str:
    """The page on the commands."""
    import click
    import typer

    from dynsim.cli.commands import app

    parts = [CLI_INTRODUCTION]

    def describe(command: Any, context: Any, depth: int) -> None:
        parts.append(f"{'#' * depth} {context.command_path}\n\n")
        parts.append(f"{_markup(command.help or '')}\n\n")
        if isinstance(command, click.Group):
            for name in command.list_commands(context):
                inner = command.get_command(context, name)
                if inner is not None and not inner.hidden:
                    describe(inner, click.Context(inner, info_name=name, parent=context), depth + 1)
            return
        parts.append(f"```text\n{context.command_path} {' '.join(command.collect_usage_pieces(context))}\n```\n\n")
        rows = []
        for parameter in command.params:
            if getattr(parameter, "hidden", False) or parameter.name == "help":
                continue
            if parameter.param_type_name == "argument":
                label, text = f"`{parameter.make_metavar(context)}`", getattr(parameter, "help", "") or ""
            else:
                label, text = ", ".join(f"`{option}`" for option in parameter.opts), parameter.help or ""
                if parameter.is_flag is False:
                    label += f" `{parameter.make_metavar(context)}`"
            rows.append(f"| {label.replace('|', chr(92) + '|')} | {_markup(text)} |")
        if rows:
            parts.append("| | |\n|---|---|\n" + "\n".join(rows) + "\n\n")
        if command.epilog:
            example = command.epilog.removeprefix("Example: ")
            parts.append(f"Example:\n\n```text\n{example}\n```\n\n")

    root = typer.main.get_command(app)
    describe(root, click.Context(root, info_name="dynsim"), 2)
    return "".join(parts)


def _markup(text: str) -> str:
    return text.replace("\n\n", "<br>").replace("\n", " ").replace("|", "\\|").replace("<br>", "\n\n").strip()
