"""Families of types that a scenario selects with ``type``: modules of dynsim or of plug-ins.

For a plant, ``type: snake`` selects the module ``dynsim.library.plants.snake`` or, if there is no such module, the
entry point ``snake`` in the group ``dynsim.plants`` of an installed package. A module ``catalogue`` of a family has
further members, see :mod:`dynsim.library.motors.catalogue`. No other registry exists. Entry points are searched only if
dynsim has no member with that name; a search takes milliseconds with few packages installed and longer with many. A
plug-in is imported only when a scenario uses it; ``dynsim list``, ``dynsim schema`` and ``dynsim check`` import all
plug-ins.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import traceback
import typing
from collections.abc import Mapping
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


# Families, with the text constants that a module needs in addition to ``Config`` and ``build``. The members of a plant
# are in the package ``dynsim.library.plants`` and in the entry points ``dynsim.plants``.
FAMILIES: Mapping[str, tuple[str, ...]] = {
    "plant": ("ENGINE",),
    "controller": ("ENGINE",),
    "path": (),
    "base_path": (),
    "surface": (),
    "motor": (),
}


CATALOGUE = "catalogue"
"""Name of a module with several members of a family: their ``NAMES``, and a function ``member(name)``."""

# Imported modules of plug-ins by family and name.
_imported: dict[tuple[str, str], ModuleType] = {}


@cache
def _modules(family: str) -> tuple[str, ...]:
    """Return the names of the modules in the package of a family."""
    package = importlib.import_module(f"dynsim.library.{family}s")
    return tuple(sorted(info.name for info in pkgutil.iter_modules(package.__path__) if not info.ispkg))


def _module(family: str, name: str) -> ModuleType:
    if name in _modules(family):
        return importlib.import_module(f"dynsim.library.{family}s.{name}")
    member: ModuleType = _module(family, CATALOGUE).member(name)
    return member


def _catalogue(family: str) -> tuple[str, ...]:
    """Return the names of the members in the module ``catalogue`` of a family; empty if it has no such module."""
    return tuple(_module(family, CATALOGUE).NAMES) if CATALOGUE in _modules(family) else ()


@cache
def shipped(family: str) -> tuple[str, ...]:
    """Return the members shipped with dynsim: the modules with a ``Config``. Imports all modules of the family."""
    return tuple(sorted(name for name in (*_modules(family), *_catalogue(family)) if is_shipped(family, name)))


def is_shipped(family: str, name: str) -> bool:
    """Return whether a name is in :func:`shipped`; imports at most that module and the catalogue."""
    if name in _modules(family):
        return hasattr(_module(family, name), "Config")
    return name in _catalogue(family)


@cache
def _entry_points(family: str) -> Mapping[str, list[EntryPoint]]:
    """Return the entry points of a family by name."""
    # Imported here because most scenarios use no plug-in.
    from importlib.metadata import entry_points

    points: dict[str, list[EntryPoint]] = {}
    for point in entry_points(group=f"dynsim.{family}s"):
        points.setdefault(point.name, []).append(point)
    return points


def names(family: str) -> tuple[str, ...]:
    """Return the names of all members, shipped or from plug-ins, including plug-ins that fail to import."""
    return tuple(sorted({*shipped(family), *_entry_points(family)}))


def members(family: str) -> tuple[str, ...]:
    """Return the names of all usable members; imports every plug-in of the family."""
    usable = list(shipped(family))
    for name in _entry_points(family):
        try:
            usable += [name] if name not in usable and _plugin(family, name) else []
        except PluginError:
            continue
    return tuple(sorted(usable))


def faults() -> list[str]:
    """Return one message per faulty plug-in; imports all plug-ins."""
    texts = []
    for family in FAMILIES:
        for name, points in _entry_points(family).items():
            if name in shipped(family):
                owners = " and ".join(map(_title, points))
                texts.append(f"{family} {name!r} of {owners} is not used: dynsim ships a {family} with this name")
                continue
            try:
                _plugin(family, name)
            except PluginError as error:
                texts.append(str(error))
    return texts


def libraries() -> dict[str, str]:
    """Return the versions of the distributions that contain the imported plug-ins."""
    points = [_entry_points(family)[name][0] for family, name in _imported]
    return dict(sorted((p.dist.name, p.dist.version) if p.dist else (p.value, "unknown") for p in points))


def member(family: str, name: str) -> ModuleType:
    """Return the module of a member.

    Raises
    ------
    PluginError
        If no member has this name, or its plug-in is faulty.
    """
    return _module(family, name) if is_shipped(family, name) else _plugin(family, name)


def build(family: str, config: Any, context: BuildContext, expected: type[T] | UnionType) -> T:
    """Build the object of a configuration with its member's ``build``, and check the type of the result.

    Parameters
    ----------
    family : str
        Key of `FAMILIES`.
    config : StrictConfig
        Validated ``Config`` of a member.
    context : BuildContext
        Context for ``build``.
    expected : type
        Required type of the result.

    Raises
    ------
    ModelError
        If the member rejects the configuration or returns an object of another type, or if a plug-in's ``build``
        fails.
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
        raise ModelError(f"{family} {config.type!r}: its build must return a {wanted}, got {brief(result)}")
    return cast(T, result)


def _line(error: Exception, module: ModuleType) -> str:
    """Return " (file:line)" if the exception comes from the module, else ""."""
    lines = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == module.__file__]
    return f" ({Path(lines[-1].filename).name}:{lines[-1].lineno})" if lines else ""


def engine(plant: Any) -> str:
    """Return the engine of a plant: the result of its module's ``engine(config)``, or the module's ``ENGINE``."""
    module = member("plant", plant.type)
    chosen = getattr(module, "engine", None)
    return str(module.ENGINE if chosen is None else chosen(plant))


def section_defaults(plant: Any, sections: Mapping[str, Any]) -> dict[str, Any]:
    """Return the plant's defaults for other sections of a scenario; both arguments are unvalidated."""
    name = plant.get("type") if isinstance(plant, Mapping) else None
    if not isinstance(name, str) or not is_shipped("plant", name):
        return {}
    defaults = getattr(member("plant", name), "section_defaults", None)
    return {} if defaults is None else dict(defaults(plant, sections))


def _plugin(family: str, name: str) -> ModuleType:
    if (family, name) in _imported:
        return _imported[family, name]
    points = _entry_points(family).get(name, [])
    if not points:
        raise PluginError(f"unknown {family} {name!r} (choices: {', '.join(names(family))})")
    point, *others = points
    if others:
        raise PluginError(f"{family} {name!r} is in {' and '.join(map(_title, points))}; uninstall all but one of them")
    try:
        module: ModuleType = point.load()
    except (Exception, SystemExit) as error:
        reason = f"importing {point.value!r} fails with {type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise PluginError(_unusable(family, point, reason)) from error
    if defect := _defect(module, family, name):
        raise PluginError(_unusable(family, point, f"{point.value!r} {defect}"))
    _imported[family, name] = module
    return module


def _unusable(family: str, point: EntryPoint, reason: str) -> str:
    return f"{family} {point.name!r} of {_title(point)} cannot be used: {reason}"


def _title(point: EntryPoint) -> str:
    """Return the name and version of an entry point's distribution."""
    return f"{point.dist.name} {point.dist.version}" if point.dist else point.value


def _defect(module: Any, family: str, name: str) -> str:
    """Return the reason why a module cannot be a member with this name, or "" if it can."""
    if not isinstance(module, ModuleType):
        return "is not a module; the entry point must refer to a module"
    config, build_ = getattr(module, "Config", None), getattr(module, "build", None)
    if not (isinstance(config, type) and issubclass(config, StrictConfig)):
        return "has no class Config derived from dynsim.config.base.StrictConfig"
    field = config.model_fields.get("type")
    if field is None or typing.get_args(field.annotation) != (name,):
        return f'has a Config whose type must be Literal["{name}"], the name of its entry point'
    if not callable(build_):
        return "has no function build(config, context)"
    try:
        inspect.signature(build_).bind(None, None)
    except (TypeError, ValueError):
        return "has a function build that does not accept (config, context)"
    for text in FAMILIES[family]:
        if not isinstance(getattr(module, text, None), str):
            return f'has no string {text}, such as "dynamics"'
    return ""


def union(family: str, only: tuple[str, ...] = ()) -> Any:
    """Return a pydantic field type: the ``Config`` of the member that the key ``type`` selects.

    Parameters
    ----------
    family : str
        Key of `FAMILIES`.
    only : tuple of str, optional
        Names of the shipped members to accept; default: all members, including plug-ins.
    """
    return Annotated[Any, MemberField(family, only)]


class MemberField:
    """Pydantic annotation of :func:`union`; validation imports only the member that ``type`` selects."""

    def __init__(self, family: str, only: tuple[str, ...] = ()) -> None:
        self.family, self.only = family, only

    def models(self) -> list[type[BaseModel]]:
        """Return the ``Config`` classes of the shipped members and of the imported plug-ins."""
        if self.only:
            return [member(self.family, name).Config for name in self.only]
        plugins = [module.Config for (family, _), module in _imported.items() if family == self.family]
        return [member(self.family, name).Config for name in shipped(self.family)] + plugins

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        return core_schema.no_info_plain_validator_function(
            self._validate,
            # Serialize each value with its own class, because the schema does not contain the classes of plug-ins.
            serialization=core_schema.wrap_serializer_function_ser_schema(_dump, schema=core_schema.any_schema()),
        )

    def __get_pydantic_json_schema__(self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler) -> Any:
        return handler(_tagged({name: member(self.family, name).Config for name in self.only or members(self.family)}))

    def _validate(self, value: Any) -> Any:
        name = value.get("type") if isinstance(value, Mapping) else getattr(value, "type", None)
        if not isinstance(name, str) or (self.only and name not in self.only):
            return _validator(self.family, self.only or shipped(self.family)).validate_python(value)
        if not is_shipped(self.family, name) and name not in _entry_points(self.family):
            known = ", ".join(map(repr, names(self.family)))
            raise PydanticKnownError(
                "union_tag_invalid", {"discriminator": "'type'", "tag": name, "expected_tags": known}
            )
        try:
            return _validator(self.family, (name,)).validate_python(value)
        except PluginError as error:
            raise error_at("type", str(error)) from None


@cache
def _validator(family: str, names: tuple[str, ...]) -> SchemaValidator:
    """Return a validator that chooses among these members."""
    return SchemaValidator(_tagged({name: member(family, name).Config for name in names}))


def _tagged(configs: Mapping[str, type[StrictConfig]]) -> core_schema.CoreSchema:
    for config in configs.values():
        config.model_rebuild()  # build the schema, which is otherwise built on first use
    choices = {name: config.__pydantic_core_schema__ for name, config in configs.items()}
    return core_schema.tagged_union_schema(choices, discriminator="type", from_attributes=True)


def _dump(value: Any, dump: core_schema.SerializerFunctionWrapHandler) -> Any:
    return dump(value)
