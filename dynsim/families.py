"""Families are found by module name: ``type: snake`` of a plant loads ``dynsim.plants.snake``; no registration list."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from types import ModuleType
from typing import Annotated, Any, Union

from pydantic import Field

# Family → package that holds its members.
PACKAGES = {
    "plant": "dynsim.plants",
    "controller": "dynsim.control",
    "path": "dynsim.control.paths",
    "surface": "dynsim.surfaces",
    "motor": "dynsim.motors",
}


@cache
def members(family: str) -> tuple[str, ...]:
    """Names of the modules of a family that expose ``Config``."""
    package = importlib.import_module(PACKAGES[family])
    names = [info.name for info in pkgutil.iter_modules(package.__path__) if not info.ispkg]
    return tuple(sorted(name for name in names if hasattr(member(family, name), "Config")))


def member(family: str, name: str) -> ModuleType:
    """The module of one member; ModuleNotFoundError when there is none."""
    if not name.isidentifier():
        raise ModuleNotFoundError(name)
    return importlib.import_module(f"{PACKAGES[family]}.{name}")


def union(family: str) -> Any:
    """A pydantic field type: the ``Config`` of whichever member of the family the key ``type`` names."""
    configs = tuple(member(family, name).Config for name in members(family))
    if len(configs) == 1:
        return configs[0]
    return Annotated[Union[configs], Field(discriminator="type")]  # noqa: UP007 (a union made at run time)
