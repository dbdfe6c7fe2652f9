"""Scenarios: YAML in, a validated description of one simulation out. Builds the members of families that it names.

A scenario file is one mapping; ``variants`` holds, by name, what differs (mappings merge, lists and values replace,
null removes). Overrides come on top. Every error names file, line, key and value.
"""

from __future__ import annotations

import difflib
import io
import itertools
import re
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field, ValidationError, field_validator

from dynsim.config import BodyPoint, NonNegative, Positive, StrictConfig
from dynsim.errors import ModelError, ScenarioError, shown
from dynsim.families import PACKAGES, member, members, union
from dynsim.files import check_complete
from dynsim.inputs import DEPTH_LIMIT, YamlMapping, is_file, parse_yaml, read_text
from dynsim.model.description import Contact, Quadric, Robot, listed
from dynsim.model.model import Model
from dynsim.shipped import SHIPPED as SHIPPED
from dynsim.shipped import shipped_scenario, shipped_scenarios

# A contact point must start this close to its surface [m].
START_TOLERANCE = 1e-6
# Bytes of the name of a folder on common file systems.
NAME_LIMIT = 255
# Numbers of a scenario, in whatever unit.
SIZE_MAX = 1e30
# Of what messages show: unknown keys, characters of a value or key.
UNKNOWN_SHOWN = 20
SHOWN_LIMIT = 80
# Variants that are searched for further unknown keys once one was found.
VARIANTS_SEARCHED = 100
# A list index in a dotted key.
_INDEX = re.compile("[0-9]{1,9}")


class ContactPoint(BodyPoint):
    """A point fixed on a body, held to a surface."""

    surface: str = "floor"
    friction: NonNegative | None = Field(default=None, description="kinetic coefficient; default: that of contacts")
    enabled: bool = True


class Contacts(StrictConfig):
    """Contact law and contact points."""

    law: Literal["bilateral"] = Field(
        default="bilateral", description="the point stays on the surface, f_n of any sign"
    )
    friction: NonNegative = 0.1
    slip_smoothing_m_s: Positive = Field(default=1e-3, description="v_s of the slip direction v_t/√(v_t² + v_s²)")
    pulling_friction: Literal["signed", "dissipative"] = Field(
        default="dissipative", description="f_t = μ f_n as printed in the paper, or μ |f_n|"
    )
    reference_tolerance_m: Positive = Field(
        default=2e-3, description="references that take a contact point further off its surface than this are refused"
    )
    points: dict[str, ContactPoint] = {}


class Integrator(StrictConfig):
    """Time integration."""

    method: Literal["rk43", "dopri5", "rk4", "rodas4"] = Field(
        default="rk43",
        description="adaptive 4(3) or 5(4), fixed step, or adaptive linearly implicit for stiff motors",
    )
    solver: Literal["articulated", "m_star"] = Field(default="articulated", description="O(n) sweeps or the dense M*")
    rtol: float = Field(default=1e-6, ge=1e-13, le=1e-1)
    atol: float = Field(default=1e-8, ge=1e-16, le=1e-1)
    step_s: Positive | None = Field(default=None, description="fixed step of rk4 (default 0.001), else the first step")
    step_max_s: Positive | None = None
    time_limit_h: Positive = Field(default=24.0, description="runs estimated to integrate for longer are refused [h]")


class RecordOptions(StrictConfig):
    """What is recorded."""

    rate_hz: Positive = 200.0
    size_limit_GB: Positive = 2.0


class Metrics(StrictConfig):
    """How the summary is computed."""

    settle_s: NonNegative = Field(default=2.0, description="tracking errors count from this time on")


class ScenarioConfig(StrictConfig):
    """A dynsim scenario."""

    name: str = Field(default="", description="default: the name of the file")
    variant: str = Field(default="", description="written into resolved scenarios")
    description: str = ""
    duration_s: Positive
    plant: union("plant")  # type: ignore[valid-type]
    controller: union("controller") | None = None  # type: ignore[valid-type]
    surfaces: dict[str, union("surface")] = {}  # type: ignore[valid-type]
    contacts: Contacts = Contacts()
    integrator: Integrator = Integrator()
    record: RecordOptions = RecordOptions()
    metrics: Metrics = Metrics()

    @field_validator("name", "variant")
    @classmethod
    def _check_folder(cls, value: str) -> str:
        """Both name folders of the results: neither may lead out of them."""
        if value in (".", "..") or any(sign in value for sign in "/\\\0"):
            raise ValueError("names a folder of the results, so it must not have slashes or be dots")
        if not value.isprintable():
            raise ValueError("names a folder of the results, so it must be printable in one line")
        if len(value.encode()) > NAME_LIMIT:
            raise ValueError(f"names a folder of the results, so it must not be longer than {NAME_LIMIT} bytes")
        return value


@dataclass(frozen=True)
class Origin:
    """Where the values of a scenario come from, so that messages can name the line of a key.

    Attributes
    ----------
    file : Path or str
        The file, or what else is to be called the source.
    mappings : tuple
        What was merged, as read: the variant's difference, then the rest of the file.
    overrides : tuple of str
        Dotted keys that were set on top, and ``overriding``, how that was done.
    """

    file: Path | str
    mappings: tuple[Any, ...] = ()
    overrides: tuple[str, ...] = ()
    overriding: str = "overrides"

    def sets(self, keys: Sequence[int | str]) -> bool:
        """True when an override set the value at ``keys``, something in it or something that it is in."""
        dotted = ".".join(map(str, keys))
        return any(
            dotted == key or dotted.startswith(key + ".") or key.startswith(dotted + ".") for key in self.overrides
        )

    def line(self, keys: Sequence[int | str]) -> int:
        """Line of the last of ``keys`` that the file has; 0 when it has none of them."""
        # The mapping that has most of the keys; of equals the first, because the variant lies over the rest.
        found = [_line(mapping, keys) for mapping in self.mappings]
        return max(found, key=lambda depth_and_line: depth_and_line[0], default=(0, 0))[1]

    def place(self, keys: Sequence[int | str]) -> str:
        """``file:line`` of a key, or how it was overridden."""
        if self.sets(keys):
            return self.overriding
        return f"{self.file}:{line}" if (line := self.line(keys)) else str(self.file)


@dataclass(frozen=True)
class Scenario:
    """One validated simulation.

    Attributes
    ----------
    name, variant : str
        The variant is "" for a scenario without variants.
    config : ScenarioConfig
    source : Path or None
        The file it came from.
    origin : Origin or None
        Lines of its keys in that file.
    """

    name: str
    variant: str
    config: ScenarioConfig
    source: Path | None = None
    origin: Origin | None = field(default=None, repr=False, compare=False)

    def __repr__(self) -> str:
        config = self.config
        parts = [config.plant.type, config.controller.type if config.controller else "no controller"]
        parts.append(f"{config.duration_s:g} s")
        contacts = [name for name, point in config.contacts.points.items() if point.enabled]
        if contacts:
            parts.append(f"contacts {listed(contacts)}")
        return f"<Scenario {self.title}: {', '.join(parts)}>"

    @property
    def title(self) -> str:
        """Name and variant, for a line of text."""
        return f"{self.name} ({self.variant})" if self.variant else self.name

    @property
    def duration_s(self) -> float:
        """Simulated time [s]."""
        return self.config.duration_s

    @property
    def plant(self) -> Any:
        """Configuration of the machine, the ``Config`` of its module."""
        return self.config.plant

    @property
    def controller(self) -> Any:
        """Configuration of the controller, None without one."""
        return self.config.controller

    @property
    def integrator(self) -> Integrator:
        """Method, solver and tolerances."""
        return self.config.integrator

    @property
    def record(self) -> RecordOptions:
        """Rate [Hz] and size limit [GB] of the record."""
        return self.config.record

    @property
    def metrics(self) -> Metrics:
        """How the summary is computed."""
        return self.config.metrics

    @property
    def engine(self) -> str:
        """What simulates the plant: the ``ENGINE`` of its module."""
        return str(member("plant", self.plant.type).ENGINE)

    @property
    def resolved(self) -> dict[str, Any]:
        """The scenario with every default and override written out; reading it again gives the same simulation."""
        return self.config.model_dump(mode="json", exclude_none=True)

    def place(self, keys: Sequence[int | str] = (), variant: str = "") -> str:
        """``file:line`` of a key, the text for ``variant``, and how the key was overridden."""
        line, overridden = 0, ""
        if keys and self.origin is not None:
            overridden = f": {self.origin.overriding}" if self.origin.sets(keys) else ""
            line = 0 if overridden else self.origin.line(keys)
        return f"{self.source or self.name}{f':{line}' if line else ''}{variant}{overridden}"

    def robot(self) -> Robot:
        """The tree of bodies with its motors (plants of the dynamics engine)."""
        return member("plant", self.plant.type).build(self.plant)

    def build_controller(self, model: Model, progress: Callable[[float], None] | None = None) -> Any:
        """The controller for the robot; ``progress`` is called with the time [s] that its references have come to."""
        if self.controller is None:
            raise ModelError("the scenario has no controller; its motors are short-circuited")
        return member("controller", self.controller.type).build(self.controller, model, self.duration_s, progress)

    def surfaces(self) -> dict[str, Quadric]:
        """All surfaces by name, whether anything touches them or not."""
        return {name: member("surface", surface.type).build(surface) for name, surface in self.config.surfaces.items()}

    def contacts(self) -> list[Contact]:
        """All enabled contact points with their surfaces."""
        options = self.config.contacts
        surfaces = self.surfaces()
        result = []
        for name, point in options.points.items():
            if not point.enabled:
                continue
            if point.surface not in surfaces:
                keys = ("contacts", "points", name, "surface")
                raise ModelError(
                    f"{_dotted(keys)} = {point.surface!r}: no such surface{_suggest(point.surface, surfaces)}; "
                    f"surfaces: {', '.join(surfaces) or 'none'}",
                    keys=keys,
                )
            result.append(
                Contact(
                    name=name,
                    body=point.body,
                    point=np.array(point.point_m),
                    surface=surfaces[point.surface],
                    surface_name=point.surface,
                    friction=options.friction if point.friction is None else point.friction,
                    slip_smoothing=options.slip_smoothing_m_s,
                    pulling_friction=options.pulling_friction,
                )
            )
        return result

    def check_start(self, model: Model) -> None:
        """Raise :class:`ModelError` unless every contact point is on a body of the robot and starts on its surface."""
        for contact in self.contacts():
            keys = ("contacts", "points", contact.name)
            try:
                position = model.point_position(contact.body, contact.point, model.robot.initial)
            except ModelError as error:
                raise ModelError(f"{_dotted((*keys, 'body'))}: {error}", keys=(*keys, "body")) from error
            gap = contact.surface.gap(position)
            if not abs(gap) <= START_TOLERANCE:
                raise ModelError(
                    f"{_dotted(keys)}: its point starts {gap:+.4g} m from surface {contact.surface_name!r} "
                    f"(limit {START_TOLERANCE:g} m), at {position.tolist()}; "
                    "change the initial configuration or the surface, or disable the contact",
                    keys=keys,
                )


def build_model(scenario: Scenario) -> Model:
    """The rigid-body model of a scenario's plant.

    Raises
    ------
    ModelError
        The plant has none, or is not physical.
    ScenarioError
        Not a scenario.
    """
    require_scenario(scenario)
    if scenario.engine != "dynamics":
        raise ModelError(f"plant {scenario.plant.type!r} is kinematic: it has no rigid-body model")
    return Model(scenario.robot())


def require_scenario(scenario: object) -> None:
    """Raise :class:`ScenarioError` for what is none, such as the name of one."""
    if not isinstance(scenario, Scenario):
        raise ScenarioError(f"needs a Scenario, not {shown(scenario)}; load_scenario(name or file) gives one")


def find_scenario(name: str | Path) -> Path:
    """The file of that path, or the shipped scenario of that name.

    Raises
    ------
    ScenarioError
        Neither exists, with near names in the message; or a folder.
    RecordError
        The scenario of a run that died while it was saved.
    """
    if not isinstance(name, (str, Path)):
        raise ScenarioError(f"a scenario is named by its file, or by its name when it is shipped, not by {shown(name)}")
    path = Path(name)
    shipped = shipped_scenario(path)
    try:
        if is_file(path, ScenarioError):
            check_complete(path)
            return path
    except ScenarioError:
        if shipped is None:
            raise
    if shipped is not None:
        return shipped
    names = [file.stem for file in shipped_scenarios()]
    raise ScenarioError(f"{name}: no such file{_suggest(path.stem, names)}; shipped scenarios: {', '.join(names)}")


def variant_names(path: str | Path) -> list[str]:
    """Names of the variants in a scenario file, in its order; empty without variants."""
    variants = _read(find_scenario(path)).get("variants")
    return list(variants) if isinstance(variants, Mapping) else []


def load_scenario(path: str | Path, variant: str | None = None, overrides: Mapping[str, Any] | None = None) -> Scenario:
    """Read, merge and validate one variant of a scenario.

    Parameters
    ----------
    path : file, or the name of a shipped scenario
    variant : name; default the first variant of the file
    overrides : values by dotted key, e.g. ``{"integrator.rtol": 1e-8, "plant.chain.0.mass_kg": 0.2}``

    Raises
    ------
    ScenarioError
        The message names file, line, key, value and the fix.
    """
    path = find_scenario(path)
    data = _read(path)
    variants = data.get("variants")
    if variants is None:
        variants = {}
    if not isinstance(variants, Mapping):
        raise ScenarioError(f"{path}:{data.lines['variants']}: variants must be a mapping of names to what differs")
    if variant is None and variants:
        variant = next(iter(variants))
    # A list of the names: what is no name need not be hashable.
    if variant is not None and variants and variant not in list(variants):
        raise ScenarioError(
            f"{path}: no variant {variant!r}{_suggest(str(variant), variants)}; "
            f"variants: {', '.join(map(_key, variants))}"
        )
    if variant is not None and not variants and variant != data.get("variant"):
        raise ScenarioError(f"{path}: has no variants, so there is no {variant!r}")
    if overrides is not None and not (
        isinstance(overrides, Mapping) and all(isinstance(key, str) for key in overrides)
    ):
        raise ScenarioError(
            f"overrides must map dotted keys to values, as {{'integrator.rtol': 1e-8}} does, not {shown(overrides)}"
        )
    merged, origin = _merged(path, data, variants, variant, overrides or {})
    try:
        config = ScenarioConfig.model_validate(merged)
    except ValidationError as error:
        unknown = _unknown_keys(error, merged, origin)
        if unknown:
            for other in [name for name in itertools.islice(variants, VARIANTS_SEARCHED) if name != variant]:
                unknown += _unknown_keys_of(path, data, variants, other, overrides or {})
        raise ScenarioError(_explain(error, merged, origin, unknown)) from None
    return Scenario(config.name, config.variant, config, path, origin)


def _merged(
    path: Path, data: YamlMapping, variants: Mapping[str, Any], variant: str | None, overrides: Mapping[str, Any]
) -> tuple[dict[str, Any], Origin]:
    """One variant of a file with overrides on top, and where its values come from."""
    shared = YamlMapping()
    shared.update({key: value for key, value in data.items() if key != "variants"})
    shared.lines = {key: line for key, line in data.lines.items() if key in shared}
    difference: Any = variants.get(variant) if variant is not None else None
    if difference is None:
        difference = {}
    if not isinstance(difference, Mapping):
        line = f":{variants.lines[variant]}" if isinstance(variants, YamlMapping) and variant is not None else ""
        raise ScenarioError(f"{path}{line}: variant {_shown(variant)} must be a mapping of what differs")
    overriding = "--set" if isinstance(overrides, SetOptions) else "overrides"
    origin = Origin(path, (difference, shared), tuple(overrides), overriding)
    merged = _plain(_merge(shared, difference))
    for key, value in overrides.items():
        _override(merged, key, _plain(value), overriding, variant)
    if merged.get("name") in (None, ""):
        merged["name"] = path.stem
    if variant is not None:
        merged["variant"] = variant
    _make_absolute(merged, path.parent)
    _check_sizes(merged, (), origin)
    return merged, origin


def _unknown_keys_of(
    path: Path, data: YamlMapping, variants: Mapping[str, Any], variant: str, overrides: Mapping[str, Any]
) -> list[str]:
    """Unknown keys of another variant; nothing when it has other faults."""
    try:
        merged, origin = _merged(path, data, variants, variant, overrides)
        ScenarioConfig.model_validate(merged)
    except ScenarioError:
        return []
    except ValidationError as error:
        return _unknown_keys(error, merged, origin)
    return []


def scenario_from_resolved(resolved: Mapping[str, Any]) -> Scenario:
    """The scenario that a record's provenance holds.

    Raises
    ------
    ScenarioError
        It was written by a version of dynsim with other keys.
    """
    if not isinstance(resolved, Mapping):
        raise ScenarioError(f"the scenario in this record must be a mapping of keys to values, not {shown(resolved)}")
    try:
        config = ScenarioConfig.model_validate(resolved)
    except ValidationError as error:
        origin = Origin("the scenario in this record")
        problem = _explain(error, resolved, origin, _unknown_keys(error, resolved, origin))
        raise ScenarioError(f"{problem}; it was written by another version of dynsim") from None
    return Scenario(config.name, config.variant, config)


class SetOptions(dict[str, Any]):
    """Overrides that were given as ``--set`` on the command line: errors call them so."""


def parse_override(text: str) -> tuple[str, Any]:
    """``a.b.c=VALUE`` as key and YAML value.

    Raises
    ------
    ScenarioError
        No ``=`` in the text, or a value that is not YAML.
    """
    key, separator, value = text.partition("=")
    key = key.strip()
    if not separator or not key:
        raise ScenarioError(f"--set {_key(text)}: must look like integrator.rtol=1e-8")
    return key, _plain(parse_yaml(value, ScenarioError, f"--set {_key(key)}", line_numbers=False))


def to_yaml(resolved: Mapping[str, Any]) -> str:
    """YAML text of a resolved scenario."""
    from ruamel.yaml import YAML

    stream = io.StringIO()
    yaml: Any = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False
    yaml.dump(dict(resolved), stream)
    return stream.getvalue()


def json_schema() -> dict[str, Any]:
    """JSON schema of scenario files, for editors; of ``variants`` it says only that they are mappings."""
    schema = _by_type(ScenarioConfig.model_json_schema())
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["properties"]["variants"] = {
        "type": "object",
        "description": "by name: what differs (mappings merge, lists and values replace, null removes)",
        "additionalProperties": {"type": ["object", "null"]},
    }
    return schema


def _by_type(schema: Any) -> Any:
    """Choices as conditions, on ``type`` and on null: of ``oneOf`` and ``anyOf`` editors say only "no match"."""
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


def choices() -> dict[str, tuple[str, ...]]:
    """Members of every family."""
    return {family: members(family) for family in PACKAGES}


def _read(path: Path) -> YamlMapping:
    data = parse_yaml(read_text(path, ScenarioError), ScenarioError, str(path))
    if data is None:
        raise ScenarioError(f"{path}: is empty; a scenario needs at least duration_s and plant")
    if not isinstance(data, YamlMapping):
        kind = "list" if isinstance(data, list) else "single value"
        raise ScenarioError(f"{path}: must be a mapping of keys to values, not a {kind}")
    return data


def _plain(value: Any) -> Any:
    """A copy of a value in plain Python types; arrays, which overrides may be, as lists."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, bool) or value is None:
        return value
    if isinstance(value, np.generic):
        return value.item()
    for kind in (int, float, str):
        if isinstance(value, kind):
            return kind(value)
    return str(value)


def _merge(base: Any, difference: Any) -> Any:
    """``difference`` laid over ``base``: mappings merge, null removes, anything else replaces."""
    if not (isinstance(base, Mapping) and isinstance(difference, Mapping)):
        return difference
    merged = {key: _merge(value, {}) if isinstance(value, Mapping) else value for key, value in base.items()}
    for key, value in difference.items():
        if value is None:
            merged.pop(key, None)
        else:
            merged[key] = _merge(merged.get(key), value)
    return merged


def _override(data: Any, key: str, value: Any, overriding: str, variant: str | None) -> None:
    """Set the dotted ``key`` in nested mappings and lists."""
    node, parts = data, str(key).split(".")
    place = f"{overriding} {_key(key)}"
    if "" in parts:
        raise ScenarioError(f"{place}: a part of the key is empty; it must look like integrator.rtol")
    if len(parts) > DEPTH_LIMIT:
        raise ScenarioError(f"{place}: has {len(parts)} parts; no key of a scenario has more than {DEPTH_LIMIT}")
    if parts[0] == "variants" or (parts[0] == "variant" and variant is not None):
        raise ScenarioError(f"{place}: which variant runs is chosen by its name (dynsim run --variant), not set")
    for depth, part in enumerate(parts):
        last = depth == len(parts) - 1
        if isinstance(node, list):
            if not _INDEX.fullmatch(part) or int(part) >= len(node):
                raise ScenarioError(f"{place}: {_shown(part)} is no index of a list of {len(node)}")
            index: Any = int(part)
        elif isinstance(node, Mapping):
            index = part
        else:
            raise ScenarioError(f"{place}: {_dotted(parts[:depth])} is a value, not a mapping")
        if last:
            node[index] = value
            return
        if isinstance(node, Mapping) and node.get(index) is None:
            node[index] = {}  # type: ignore[index]
        node = node[index]


def _make_absolute(data: Any, folder: Path) -> None:
    """Paths in keys named ``file`` are relative to the scenario."""
    if isinstance(data, dict):
        for key, value in data.items():
            if key == "file" and isinstance(value, str):
                # A name that no file can have is left for its reader to refuse.
                with suppress(OSError, ValueError, RuntimeError):
                    data[key] = str((folder / value).resolve())
            else:
                _make_absolute(value, folder)
    elif isinstance(data, list):
        for item in data:
            _make_absolute(item, folder)


def _unknown_keys(error: ValidationError, merged: Any, origin: Origin) -> list[str]:
    """Every unknown key: place, key, and the known one that it is like."""
    texts: list[str] = []
    for problem in error.errors(include_url=False, include_input=False):
        if problem["type"] != "extra_forbidden" or len(texts) > UNKNOWN_SHOWN:
            continue
        keys, _, _ = _locate(merged, problem["loc"])
        known = _fields(problem["loc"][:-1]) + (["variants"] if len(keys) == 1 else [])
        suggestion = _suggest(str(keys[-1]), known)
        if not suggestion and known:
            suggestion = f"; known here: {', '.join(known)}"
        texts.append(f"{origin.place(keys)}: {_dotted(keys)}: unknown key{suggestion}")
    return texts


def _check_sizes(value: Any, keys: tuple[int | str, ...], origin: Origin) -> None:
    """Refuse numbers whose powers and products leave the range of a float; other checks see to NaN and infinity."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            _check_sizes(item, (*keys, key), origin)
    elif isinstance(value, int | float) and (SIZE_MAX < abs(value) < np.inf or 0 < abs(value) < 1.0 / SIZE_MAX):
        raise ScenarioError(
            f"{origin.place(keys)}: {_dotted(keys)} = {_shown(value)}: its size must be between "
            f"{1.0 / SIZE_MAX:g} and {SIZE_MAX:g}, or zero"
        )


def _explain(error: ValidationError, merged: Any, origin: Origin, unknown: Sequence[str]) -> str:
    """One line with file:line, key, value and fix: all unknown keys, else the first problem."""
    problems = error.errors(include_url=False, include_input=False)
    if unknown:
        # These first and alone: a misspelt key also makes the right one missing.
        texts = list(dict.fromkeys(unknown))
        shown = "; ".join(texts[:UNKNOWN_SHOWN]) + ("; and more" if len(texts) > UNKNOWN_SHOWN else "")
        return shown + _and_more(sum(problem["type"] != "extra_forbidden" for problem in problems))
    problem = problems[0]
    loc = (*problem["loc"], *problem.get("ctx", {}).get("key", "").split("."))
    keys, value, found = _locate(merged, tuple(part for part in loc if part != ""))
    kind, message = problem["type"], problem["msg"].removeprefix("Value error, ")
    more = len(problems) - 1
    if kind == "missing" and isinstance(problem["loc"][-1], int) and isinstance(value, list):
        # One problem for every entry that a list of fixed length lacks.
        lacking = sum(p["type"] == kind and p["loc"][:-1] == problem["loc"][:-1] for p in problems)
        text = f"has {len(value)} entries, {len(value) + lacking} are needed"
        more -= lacking - 1
    elif kind == "missing":
        text = "is missing; add it"
    elif kind in ("union_tag_invalid", "union_tag_not_found"):
        expected = problem["ctx"].get("expected_tags", "").replace("'", "") if "ctx" in problem else ""
        tag = value.get("type", "") if isinstance(value, Mapping) else ""
        keys = [*keys, "type"]
        if tag:
            text = f"unknown type {_shown(tag)}{_suggest(str(tag), expected.split(', '))}; known: {expected}"
        else:
            text = "is missing; it says which one" + (f": {expected}" if expected else "")
        found = False
    elif kind in ("model_type", "dict_type", "model_attributes_type"):
        text = "must be a mapping of keys to values"
    else:
        text = " ".join((message[0].lower() + message[1:]).splitlines())
    given = f" = {_shown(value)}" if found and not isinstance(value, (Mapping, list)) else ""
    return f"{origin.place(keys)}: {_dotted(keys)}{given}: {text}{_and_more(more)}"


def _and_more(count: int) -> str:
    return f" (and {count} more)" if count > 0 else ""


def _key(key: object) -> str:
    """A key for a message: in one line and not too long."""
    text = str(key)
    text = text if len(text) <= SHOWN_LIMIT else text[:SHOWN_LIMIT] + "…"
    return text if text.isprintable() else repr(text)[1:-1]


def _dotted(keys: Sequence[int | str]) -> str:
    return ".".join(_key(key) if key != "" else "''" for key in keys)


def _shown(value: object) -> str:
    """A value for a message: in one line and not too long."""
    if isinstance(value, str):
        return repr(value if len(value) <= SHOWN_LIMIT else value[:SHOWN_LIMIT] + "…")
    text = repr(value)
    return text if len(text) <= SHOWN_LIMIT else text[:SHOWN_LIMIT] + "…"


def _locate(data: Any, loc: tuple[int | str, ...]) -> tuple[list[int | str], Any, bool]:
    """Keys of a pydantic location without its union tags; the value there, and whether there is one."""
    keys: list[int | str] = []
    node, found = data, True
    for part in loc:
        if isinstance(node, list) and isinstance(part, str) and _INDEX.fullmatch(part):
            part = int(part)  # of a dotted key
        in_mapping = isinstance(node, Mapping) and part in node
        in_list = isinstance(node, list) and isinstance(part, int) and part < len(node)
        if found and (in_mapping or in_list):
            node = node[part]
        elif isinstance(node, Mapping) and node.get("type") == part:
            continue
        elif found and isinstance(node, (int, float, str, list)):
            # Branches of a union of plain types, such as "float" and "list[float]".
            continue
        else:
            found = False
        keys.append(part)
    return keys, node, found


def _line(mapping: Any, keys: Sequence[int | str]) -> tuple[int, int]:
    """How many of ``keys`` lead into a mapping of a YAML file, and the line of the last of them; (0, 0) for none."""
    depth = line = 0
    node = mapping
    for key in keys:
        lines = getattr(node, "lines", {})
        if key not in lines:
            break
        depth, line = depth + 1, lines[key]
        node = node[key]
    return depth, line


def _fields(loc: tuple[int | str, ...]) -> list[str]:
    """Keys that a scenario may have at a pydantic location."""
    classes: list[type[BaseModel]] = [ScenarioConfig]
    for part in loc:
        held = [c.model_fields[part].annotation for c in classes if isinstance(part, str) and part in c.model_fields]
        if held:
            classes = [c for annotation in held for c in _models(annotation)]
        else:
            tagged = [c for c in classes if part in _literals(c)]
            classes = tagged or classes
    return [name for c in classes for name in c.model_fields]


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias):
        return [annotation] if issubclass(annotation, BaseModel) else []
    return [model for argument in typing.get_args(annotation) for model in _models(argument)]


def _literals(model: type[BaseModel]) -> tuple[Any, ...]:
    return typing.get_args(model.model_fields["type"].annotation) if "type" in model.model_fields else ()


def _suggest(word: str, known: Any) -> str:
    if len(word) > SHOWN_LIMIT:
        return ""  # the comparison takes the square of the length
    near = difflib.get_close_matches(word, [str(k) for k in itertools.islice(known, 1000)], n=1, cutoff=0.6)
    return f"; did you mean {near[0]!r}?" if near else ""
