"""The JSON schema of scenario files, for editors."""

from __future__ import annotations

from typing import Any

from dynsim.scenario.schema import ScenarioConfig


def json_schema() -> dict[str, Any]:
    """JSON schema of scenario files, for editors; it constrains ``variants`` only to be mappings."""
    schema = _by_type(ScenarioConfig.model_json_schema())
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["properties"]["variants"] = {
        "type": "object",
        "description": "by name: what differs (mappings merge, lists and values replace, null removes)",
        "additionalProperties": {"type": ["object", "null"]},
    }
    return schema


def _by_type(schema: Any) -> Any:
    """Choices as conditions on ``type`` and on null: for ``oneOf`` and ``anyOf`` editors report only "no match"."""
    if isinstance(schema, list):
        return [_by_type(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    schema = {key: _by_type(item) for key, item in schema.items()}
    chosen = [item for item in schema.get("anyOf", ()) if item != {"type": "null"}]
    if len(chosen) == 1 and len(schema["anyOf"]) == 2 and ("$ref" in chosen[0] or "discriminator" in chosen[0]):
        del schema["anyOf"]
        return schema | {"if": {"type": "null"}, "else": chosen[0]}
    if "oneOf" not in schema or "discriminator" not in schema:
        return schema
    del schema["oneOf"]
    mapping = schema["discriminator"]["mapping"]
    return schema | {
        "type": "object",
        "required": ["type"],
        "properties": {"type": {"enum": list(mapping)}},
        "allOf": [
            {"if": {"properties": {"type": {"const": name}}, "required": ["type"]}, "then": {"$ref": reference}}
            for name, reference in mapping.items()
        ],
    }
