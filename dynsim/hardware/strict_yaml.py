"""YAML files for hardware (servo maps, fault scripts, gates) as pydantic models; errors name file, line and key."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationError
from pydantic_core import core_schema

from dynsim.config.problems import Origin, explain, unknown_keys
from dynsim.hardware.errors import ServoMapError
from dynsim.system.inputs import parse_yaml, read_text

Objection = tuple[str, str]
"""Dotted key of a file, and the reason why its value is refused."""


@dataclass(frozen=True)
class Within:
    """Annotation of a number from ``low`` to ``high``; its error gives the reason and a valid value."""

    low: float
    high: float
    unit: str
    why: str

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        return core_schema.no_info_after_validator_function(self._checked, handler(source))

    def __get_pydantic_json_schema__(self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler) -> Any:
        json_schema = {key: value for key, value in handler(schema).items() if key != "exclusiveMinimum"}
        return json_schema | {"minimum": self.low, "maximum": self.high}

    def _checked(self, value: float) -> float:
        if not self.low <= value <= self.high:
            bounds = f"{self.low:g} to {self.high:g}{self.unit and ' ' + self.unit}"
            raise ValueError(f"{self.why}; use {bounds}")
        return value


_Schema = TypeVar("_Schema", bound=BaseModel)


def rounded_up(value: float) -> float:
    """A short number to offer instead of one that was refused, not below ``value``: to 1e-4."""
    return math.ceil(value * 1e4) / 1e4


def read_yaml(path: Path, schema: type[_Schema], context: dict[str, Any] | None = None) -> _Schema:
    """Read YAML into a pydantic model, whose validators are given ``context``; see :func:`read_located`."""
    return read_located(path, schema, context)[0]


def read_located(path: Path, schema: type[_Schema], context: dict[str, Any] | None = None) -> tuple[_Schema, Origin]:
    """The same, with where its keys are in the file.

    Raises
    ------
    ServoMapError
        Missing file, bad YAML or bad entry; the message holds file, line and key.
    """
    data = parse_yaml(read_text(path, ServoMapError), ServoMapError, str(path))
    if not isinstance(data, dict):
        raise ServoMapError(f"{path}: expected a mapping with the keys {', '.join(schema.model_fields)}")
    origin = Origin(path, (data,))
    try:
        return schema.model_validate(data, context=context), origin
    except ValidationError as error:
        raise ServoMapError(explain(error, data, origin, unknown_keys(error, data, origin, schema))) from None
