"""Families of types that a scenario chooses by ``type``: modules of the package or of plug-ins.

``type: snake`` of a plant is the module ``dynsim.library.plants.snake``, else the entry point ``snake`` of the group
``dynsim.plants`` of an installed package. There is no other list. Entry points are looked for only when the package
has no member of that name (looking takes milliseconds with few packages installed, more with many), and no plug-in is
imported before a scenario names it; ``dynsim list``, ``dynsim schema`` and ``dynsim check`` look at all of them.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import traceback
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast

from pydantic import BaseModel, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import PydanticKnownError, SchemaValidator, core_schema

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import StrictConfig, error_at
from dynsim.errors import DynsimError, ModelError, PluginError, brief

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

T = TypeVar("T")


@dataclass(frozen=True)
class Family:
    """Where the members of a family are, and the texts that a module must have beside ``Config`` and ``build``."""

    package: str
    group: str
    texts: tuple[str, ...] = ()


FAMILIES = {
    "plant": Family("dynsim.library.plants", "dynsim.plants", ("ENGINE",)),
    "controller": Family("dynsim.library.controllers", "dynsim.controllers", ("ENGINE",)),
    "path": Family("dynsim.library.paths", "dynsim.paths"),
    "base_path": Family("dynsim.library.base_paths", "dynsim.base_paths"),
    "surface": Family("dynsim.library.surfaces", "dynsim.surfaces"),
    "motor": Family("dynsim.library.motors", "dynsim.motors"),
}


@dataclass(frozen=True)
class Plugin:
    """A member outside the package."""

    module: ModuleType
    library: tuple[str, str]
    validator: SchemaValidator


# Those that were imported, by family and name.
_imported: dict[tuple[str, str], Plugin] = {}


@cache
def _modules(family: str) -> tuple[str, ...]:
    """Names of the modules in the package of a family."""
    package = importlib.import_module(FAMILIES[family].package)
    return tuple(sorted(info.name for info in pkgutil.iter_modules(package.__path__) if not info.ispkg))


def _module(family: str, name: str) -> ModuleType:
    return importlib.import_module(f"{FAMILIES[family].package}.{name}")


@cache
def shipped(family: str) -> tuple[str, ...]:
    """Members in the package: the modules that expose ``Config``. Imports all of them."""
    return tuple(name for name in _modules(family) if is_shipped(family, name))


def is_shipped(family: str, name: str) -> bool:
    """Whether a name is one of :func:`shipped`; imports that module at most."""
    return name in _modules(family) and hasattr(_module(family, name), "Config")


@cache
def _entry_points(family: str) -> Mapping[str, list[EntryPoint]]:
    """Entry points of a family by name."""
    # Imported here: most scenarios need none.
    from importlib.metadata import entry_points

    points: dict[str, list[EntryPoint]] = {}
    for point in entry_points(group=FAMILIES[family].group):
        points.setdefault(point.name, []).append(point)
    return points


def names(family: str) -> tuple[str, ...]:
    """Names of all members, in the package and in plug-ins, whether these work or not."""
    return tuple(sorted({*shipped(family), *_entry_points(family)}))


def members(family: str) -> tuple[str, ...]:
    """Names of the members that work; imports every plug-in of the family."""
    usable = list(shipped(family))
    for name in _entry_points(family):
        try:
            usable += [name] if name not in usable and _plugin(family, name) else []
        except PluginError:
            continue
    return tuple(sorted(usable))


def faults() -> list[str]:
    """What is wrong with the plug-ins that are installed, a line for each; imports all of them."""
    texts = []
    for family in FAMILIES:
        for name, points in _entry_points(family).items():
            if name in shipped(family):
                owners = " and ".join(map(_title, points))
                texts.append(f"{family} {name!r} of {owners} is not used: dynsim has its own of that name")
                continue
            try:
                _plugin(family, name)
            except PluginError as error:
                texts.append(str(error))
    return texts


def libraries() -> dict[str, str]:
    """Distributions whose plug-ins were imported, and their versions."""
    return dict(sorted({plugin.library for plugin in _imported.values()}))


def member(family: str, name: str) -> ModuleType:
    """The module of one member.

    Raises
    ------
    PluginError
        There is none of that name, or it is a plug-in that does not work.
    """
    return _module(family, name) if is_shipped(family, name) else _plugin(family, name).module


def build(family: str, config: Any, context: BuildContext, expected: type[T] | UnionType) -> T:
    """What the member that a configuration belongs to makes of it, checked to be what the family gives.

    Raises
    ------
    ModelError
        The member says so, or gives something else; the build of a plug-in fails.
    """
    module = member(family, config.type)
    try:
        result = module.build(config, context)
    except (DynsimError, MemoryError):
        raise
    except Exception as error:
        if is_shipped(family, config.type):
            raise
        text = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise ModelError(f"{family} {config.type!r}: its build fails with {text}{_line(error, module)}") from error
    if not isinstance(result, expected):
        wanted = " or ".join(kind.__name__ for kind in typing.get_args(expected) or (expected,))
        raise ModelError(f"{family} {config.type!r}: its build must return a {wanted}, not {brief(result)}")
    return cast(T, result)


def _line(error: Exception, module: ModuleType) -> str:
    """Where in a module an exception comes from, " (file:line)"; "" when not from there."""
    lines = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == module.__file__]
    return f" ({Path(lines[-1].filename).name}:{lines[-1].lineno})" if lines else ""


def engine(plant: Any) -> str:
    """What simulates the plant of a configuration: the ``engine(config)`` of its module, or its ``ENGINE``."""
    module = member("plant", plant.type)
    chosen = getattr(module, "engine", None)
    return str(module.ENGINE if chosen is None else chosen(plant))


def section_defaults(plant: Any, sections: Mapping[str, Any]) -> dict[str, Any]:
    """What a plant that was read, not validated, wants other sections to say where they do not say otherwise."""
    name = plant.get("type") if isinstance(plant, Mapping) else None
    if not isinstance(name, str) or not is_shipped("plant", name):
        return {}
    defaults = getattr(member("plant", name), "section_defaults", None)
    return {} if defaults is None else dict(defaults(plant, sections))


def _plugin(family: str, name: str) -> Plugin:
    if (family, name) in _imported:
        return _imported[family, name]
    points = _entry_points(family).get(name, [])
    if not points:
        raise PluginError(f"no {family} {name!r}; known: {', '.join(names(family))}")
    point, *others = points
    if others:
        raise PluginError(f"{family} {name!r} is in {' and '.join(map(_title, points))}: uninstall all but one of them")
    try:
        module = point.load()
    except (Exception, SystemExit) as error:
        reason = f"importing {point.value!r} fails with {type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise PluginError(_unusable(family, point, reason)) from error
    if lack := _lack(module, FAMILIES[family], name):
        raise PluginError(_unusable(family, point, f"{point.value!r} {lack}"))
    library = (point.dist.name, point.dist.version) if point.dist else (point.value, "unknown")
    _imported[family, name] = Plugin(module, library, SchemaValidator(_tagged({name: module.Config})))
    return _imported[family, name]


def _unusable(family: str, point: EntryPoint, reason: str) -> str:
    return f"{family} {point.name!r} of {_title(point)} cannot be used: {reason}"


def _title(point: EntryPoint) -> str:
    """The distribution of an entry point."""
    return f"{point.dist.name} {point.dist.version}" if point.dist else point.value


def _lack(module: Any, family: Family, name: str) -> str:
    """What keeps a module from being a member of that name, "" when nothing does."""
    if not isinstance(module, ModuleType):
        return "is no module; an entry point names one"
    config, build_ = getattr(module, "Config", None), getattr(module, "build", None)
    if not (isinstance(config, type) and issubclass(config, StrictConfig)):
        return "has no class Config derived from dynsim.config.base.StrictConfig"
    field = config.model_fields.get("type")
    if field is None or typing.get_args(field.annotation) != (name,):
        return f'has a Config whose type is not Literal["{name}"], the name of its entry point'
    if not callable(build_):
        return "has no function build(config, context)"
    try:
        inspect.signature(build_).bind(None, None)
    except (TypeError, ValueError):
        return "has a build that does not take (config, context)"
    for text in family.texts:
        if not isinstance(getattr(module, text, None), str):
            return f'has no text {text}, such as "dynamics"'
    return ""


def union(family: str, only: tuple[str, ...] = ()) -> Any:
    """A pydantic field type: the ``Config`` of whichever member of the family the key ``type`` names.

    ``only`` : these of the package's members and no others; default: all, and plug-ins
    """
    return Annotated[Any, MemberField(family, only)]


class MemberField:
    """Pydantic's side of :func:`union`: the member that ``type`` names, and no other is imported to validate it."""

    def __init__(self, family: str, only: tuple[str, ...] = ()) -> None:
        self.family, self.only = family, only

    def models(self) -> list[type[BaseModel]]:
        """Configurations of the package's members and of the plug-ins in use."""
        if self.only:
            return [member(self.family, name).Config for name in self.only]
        plugins = [plugin.module.Config for (family, _), plugin in _imported.items() if family == self.family]
        return [member(self.family, name).Config for name in shipped(self.family)] + plugins

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        return core_schema.no_info_plain_validator_function(
            self._validate,
            # Each by its own class: that of a plug-in is not in the schema.
            serialization=core_schema.wrap_serializer_function_ser_schema(_dump, schema=core_schema.any_schema()),
        )

    def __get_pydantic_json_schema__(self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler) -> Any:
        return handler(_tagged({name: member(self.family, name).Config for name in self.only or members(self.family)}))

    def _validate(self, value: Any) -> Any:
        name = value.get("type") if isinstance(value, Mapping) else getattr(value, "type", None)
        if not isinstance(name, str) or (self.only and name not in self.only):
            return _validator(self.family, self.only or shipped(self.family)).validate_python(value)
        if is_shipped(self.family, name):
            return _validator(self.family, (name,)).validate_python(value)
        if name not in _entry_points(self.family):
            known = ", ".join(map(repr, names(self.family)))
            raise PydanticKnownError(
                "union_tag_invalid", {"discriminator": "'type'", "tag": name, "expected_tags": known}
            )
        try:
            return _plugin(self.family, name).validator.validate_python(value)
        except PluginError as error:
            raise error_at("type", str(error)) from None


@cache
def _validator(family: str, names: tuple[str, ...]) -> SchemaValidator:
    """Of a choice among these members of the package."""
    return SchemaValidator(_tagged({name: member(family, name).Config for name in names}))


def _tagged(configs: Mapping[str, type[StrictConfig]]) -> core_schema.CoreSchema:
    for config in configs.values():
        config.model_rebuild()  # the schema of a configuration is made when it is first asked for
    choices = {name: config.__pydantic_core_schema__ for name, config in configs.items()}
    return core_schema.tagged_union_schema(choices, discriminator="type", from_attributes=True)


def _dump(value: Any, dump: core_schema.SerializerFunctionWrapHandler) -> Any:
    return dump(value)
