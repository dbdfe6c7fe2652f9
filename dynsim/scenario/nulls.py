"""Nulls of a resolved scenario: those in whose place a default would come where they were left out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel


def write_nulls(config: BaseModel, written: dict[str, Any], defaults: Any = None) -> None:
    """Write ``null`` where a configuration has it and its member, or the plant, has another default.

    ``written`` : the configuration as it was dumped without nulls; ``defaults`` : those of the plant, of the same form
    """
    for key, member in type(config).model_fields.items():
        value, of_plant = getattr(config, key), _entry(defaults, key)
        if value is not None:
            _write_within(value, written.get(key), of_plant)
        elif not member.exclude and (member.default is not None or of_plant is not None):
            written[key] = None


def _write_within(value: Any, written: Any, defaults: Any) -> None:
    """The same for a value: a configuration, or several of them in a mapping or list."""
    if isinstance(value, BaseModel):
        if isinstance(written, dict):
            write_nulls(value, written, defaults)
    elif isinstance(value, Mapping) and isinstance(written, Mapping):
        for name, part in value.items():
            _write_within(part, _entry(written, name), _entry(defaults, name))
    elif isinstance(value, (list, tuple)) and isinstance(written, list):
        for part, dumped in zip(value, written, strict=True):
            _write_within(part, dumped, None)


def _entry(mapping: Any, key: Any) -> Any:
    return mapping.get(key) if isinstance(mapping, Mapping) else None
