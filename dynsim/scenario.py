"""Scenarios: YAML in, a validated description of one simulation out. Builds the members of families that it names.

A scenario file is one mapping; ``variants`` holds, by name, what differs (mappings merge, lists and values replace,
null removes). Overrides come on top. Every error names file, line, key and value.
"""

from __future__ import annotations

import copy
import difflib
import io
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field, ValidationError, field_validator

from dynsim.config import BodyPoint, NonNegative, Positive, StrictConfig
from dynsim.errors import ModelError, ScenarioError
from dynsim.families import PACKAGES, member, members, union
from dynsim.model.description import Contact, Quadric, Robot
from dynsim.model.model import Model

_CHECKOUT = Path(__file__).resolve().parent.parent / "scenarios"
SHIPPED = _CHECKOUT if _CHECKOUT.is_dir() else Path(__file__).resolve().parent / "shipped_scenarios"

# A contact point must start this close to its surface [m].
START_TOLERANCE = 1e-6


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
        return value


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
    """

    name: str
    variant: str
    config: ScenarioConfig
    source: Path | None = None

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

    def robot(self) -> Robot:
        """The tree of bodies with its motors (plants of the dynamics engine)."""
        return member("plant", self.plant.type).build(self.plant)

    def build_controller(self, model: Model, progress: Callable[[float], None] | None = None) -> Any:
        """The controller for the robot; ``progress`` is called with the time [s] that its references have come to."""
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
                raise ModelError(
                    f"contact {name}: no surface {point.surface!r}{_suggest(point.surface, surfaces)}; "
                    f"surfaces: {', '.join(surfaces) or 'none'}"
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
        """Raise :class:`ModelError` unless every contact point starts on its surface."""
        for contact in self.contacts():
            position = model.point_position(contact.body, contact.point, model.robot.initial)
            gap = contact.surface.gap(position)
            if not abs(gap) <= START_TOLERANCE:
                raise ModelError(
                    f"contact {contact.name}: its point starts {gap:+.4g} m from surface {contact.surface_name!r} "
                    f"(limit {START_TOLERANCE:g} m), at ({position[0]:.4g}, {position[1]:.4g}, {position[2]:.4g}); "
                    "change the initial configuration or the surface, or disable the contact"
                )


def build_model(scenario: Scenario) -> Model:
    """The rigid-body model of a scenario's plant."""
    if scenario.engine != "dynamics":
        raise ModelError(f"plant {scenario.plant.type!r} is kinematic: it has no rigid-body model")
    return Model(scenario.robot())


def find_scenario(name: str | Path) -> Path:
    """The file of that path, or the shipped scenario of that name.

    Raises
    ------
    ScenarioError
        Neither exists, with near names in the message; or a folder.
    """
    path = Path(name)
    if path.is_file():
        return path
    if path.is_dir():
        raise ScenarioError(f"{name}: is a folder; a scenario is a YAML file")
    for candidate in (SHIPPED / path.name, SHIPPED / f"{path.name}.yaml"):
        if candidate.is_file() and path.parent in (Path(), Path("scenarios")):
            return candidate
    shipped = shipped_scenarios()
    raise ScenarioError(
        f"{name}: no such file{_suggest(path.stem, [p.stem for p in shipped])}; "
        f"shipped scenarios: {', '.join(p.stem for p in shipped)}"
    )


def shipped_scenarios() -> list[Path]:
    """Scenario files that come with dynsim."""
    return sorted(SHIPPED.glob("*.yaml"))


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
    variants = data.pop("variants", None) or {}
    if not isinstance(variants, Mapping):
        raise ScenarioError(f"{path}: variants must be a mapping of names to what differs")
    if variant is None and variants:
        variant = next(iter(variants))
    if variant is not None and variants and variant not in variants:
        raise ScenarioError(
            f"{path}: no variant {variant!r}{_suggest(variant, variants)}; variants: {', '.join(variants)}"
        )
    if variant is not None and not variants and variant != data.get("variant"):
        raise ScenarioError(f"{path}: has no variants, so there is no {variant!r}")
    difference = (variants.get(variant) or {}) if variant is not None else {}
    if not isinstance(difference, Mapping):
        raise ScenarioError(f"{path}: variant {variant!r} must be a mapping of what differs")
    merged = _merge(data, difference)
    for key, value in (overrides or {}).items():
        _override(merged, key, value, _origin(overrides))
    merged = _plain(merged)
    merged["name"] = merged.get("name") or path.stem
    if variant is not None:
        merged["variant"] = variant
    _make_absolute(merged, path.parent)
    try:
        config = ScenarioConfig.model_validate(merged)
    except ValidationError as error:
        raise ScenarioError(_explain(error, path, merged, (difference, data), overrides or {})) from None
    return Scenario(config.name, config.variant, config, path)


def scenario_from_resolved(resolved: Mapping[str, Any]) -> Scenario:
    """The scenario that a record's provenance holds.

    Raises
    ------
    ScenarioError
        It was written by a version of dynsim with other keys.
    """
    try:
        config = ScenarioConfig.model_validate(resolved)
    except ValidationError as error:
        problem = _explain(error, "the scenario in this record", resolved, (), {})
        raise ScenarioError(f"{problem}; it was written by another version of dynsim") from None
    return Scenario(config.name, config.variant, config)


class SetOptions(dict[str, Any]):
    """Overrides that were given as ``--set`` on the command line: errors call them so."""


def _origin(overrides: Mapping[str, Any] | None) -> str:
    return "--set" if isinstance(overrides, SetOptions) else "overrides"


def parse_override(text: str) -> tuple[str, Any]:
    """``a.b.c=VALUE`` as key and YAML value.

    Raises
    ------
    ScenarioError
        No ``=`` in the text, or a value that is not YAML.
    """
    key, separator, value = text.partition("=")
    if not separator or not key.strip():
        raise ScenarioError(f"--set {text}: must look like integrator.rtol=1e-8")
    return key.strip(), _plain(_parse_yaml(value, f"--set {key.strip()}"))


def to_yaml(resolved: Mapping[str, Any]) -> str:
    """YAML text of a resolved scenario."""
    stream = io.StringIO()
    yaml = _yaml("safe")
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False
    yaml.dump(dict(resolved), stream)
    return stream.getvalue()


def json_schema() -> dict[str, Any]:
    """JSON schema of scenario files, for editors; of ``variants`` it says only that they are mappings."""
    schema = ScenarioConfig.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["properties"]["variants"] = {
        "type": "object",
        "description": "by name: what differs (mappings merge, lists and values replace, null removes)",
        "additionalProperties": {"type": ["object", "null"]},
    }
    return schema


def choices() -> dict[str, tuple[str, ...]]:
    """Members of every family."""
    return {family: members(family) for family in PACKAGES}


def _yaml(kind: str) -> Any:
    from ruamel.yaml import YAML

    return YAML(typ=kind, pure=kind == "rt")


def _read(path: Path) -> Any:
    from ruamel.yaml.comments import CommentedMap

    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise ScenarioError(
            f"{path}:{line}: byte 0x{error.object[error.start]:02x} is not UTF-8; save it as UTF-8"
        ) from error
    data = _parse_yaml(text, str(path))
    if data is None:
        raise ScenarioError(f"{path}: is empty; a scenario needs at least duration_s and plant")
    if not isinstance(data, CommentedMap):
        kind = "list" if isinstance(data, list) else "single value"
        raise ScenarioError(f"{path}: must be a mapping of keys to values, not a {kind}")
    return data


def _parse_yaml(text: str, source: str) -> Any:
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    try:
        return _yaml("rt").load(text)
    except MarkedYAMLError as error:
        line = f":{error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ScenarioError(f"{source}{line}: not YAML: {error.problem or error.context}") from None
    except YAMLError as error:
        raise ScenarioError(f"{source}: not YAML: {str(error).splitlines()[0]}") from None


def _plain(value: Any) -> Any:
    """Round-trip YAML nodes as plain Python values."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, bool) or value is None:
        return value
    for kind in (int, float, str):
        if isinstance(value, kind):
            return kind(value)
    return str(value)


def _merge(base: Any, difference: Any) -> Any:
    """``difference`` laid over ``base``: mappings merge, null removes, anything else replaces."""
    if not (isinstance(base, Mapping) and isinstance(difference, Mapping)):
        return copy.copy(difference)
    merged = {key: _merge(value, {}) if isinstance(value, Mapping) else value for key, value in base.items()}
    for key, value in difference.items():
        if value is None:
            merged.pop(key, None)
        else:
            merged[key] = _merge(merged.get(key), value)
    return merged


def _override(data: Any, key: str, value: Any, origin: str) -> None:
    """Set the dotted ``key`` in nested mappings and lists."""
    node, parts = data, key.split(".")
    for depth, part in enumerate(parts):
        last = depth == len(parts) - 1
        if isinstance(node, list):
            if not part.isdigit() or int(part) >= len(node):
                raise ScenarioError(f"{origin} {key}: {part!r} is no index of a list of {len(node)}")
            index: Any = int(part)
        elif isinstance(node, Mapping):
            index = part
        else:
            raise ScenarioError(f"{origin} {key}: {'.'.join(parts[:depth])} is a value, not a mapping")
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
                data[key] = str((folder / value).resolve())
            else:
                _make_absolute(value, folder)
    elif isinstance(data, list):
        for item in data:
            _make_absolute(item, folder)


def _explain(
    error: ValidationError, path: Path | str, merged: Any, sources: tuple[Any, ...], overrides: Mapping[str, Any]
) -> str:
    """The first problem in one line: file:line, key, value, fix."""
    problems = error.errors()
    # Unknown keys first: a misspelt key also makes the right one missing.
    problem = next((p for p in problems if p["type"] == "extra_forbidden"), problems[0])
    loc = (*problem["loc"], *problem.get("ctx", {}).get("key", "").split("."))
    keys, value, found = _locate(merged, tuple(part for part in loc if part != ""))
    dotted = ".".join(str(key) for key in keys)
    # The source that has most of the keys; of equals the first, because the variant lies over the rest.
    found_in = [_line(source, keys) for source in sources]
    _, line = max(found_in, key=lambda depth_and_line: depth_and_line[0], default=(0, 0))
    place = f"{path}:{line}" if line else str(path)
    if any(dotted == key or dotted.startswith(key + ".") or key.startswith(dotted + ".") for key in overrides):
        place = _origin(overrides)
    kind, message = problem["type"], problem["msg"].removeprefix("Value error, ")
    if kind == "extra_forbidden":
        known = _fields(problem["loc"][:-1]) + (["variants"] if len(keys) == 1 else [])
        text = f"unknown key{_suggest(str(keys[-1]), known)}"
        if not text.endswith("?"):
            text += f"; known here: {', '.join(known)}" if known else ""
    elif kind == "missing" and isinstance(problem["loc"][-1], int) and isinstance(value, list):
        # One problem for every entry that a list of fixed length lacks.
        lacking = [p for p in problems if p["type"] == kind and p["loc"][:-1] == problem["loc"][:-1]]
        text = f"has {len(value)} entries, {len(value) + len(lacking)} are needed"
        problems = [p for p in problems if p is problem or p not in lacking]
    elif kind == "missing":
        text = "is missing; add it"
    elif kind in ("union_tag_invalid", "union_tag_not_found"):
        expected = problem["ctx"].get("expected_tags", "").replace("'", "") if "ctx" in problem else ""
        tag = value.get("type", "") if isinstance(value, Mapping) else ""
        dotted += ".type"
        if tag:
            text = f"unknown type {tag!r}{_suggest(str(tag), expected.split(', '))}; known: {expected}"
        else:
            text = "is missing; it says which one" + (f": {expected}" if expected else "")
        found = False
    elif kind in ("model_type", "dict_type", "model_attributes_type"):
        text = "must be a mapping of keys to values"
    else:
        text = message[0].lower() + message[1:]
    shown = f" = {value!r}" if found and not isinstance(value, (Mapping, list)) and kind != "extra_forbidden" else ""
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return f"{place}: {dotted}{shown}: {text}{more}"


def _locate(data: Any, loc: tuple[int | str, ...]) -> tuple[list[int | str], Any, bool]:
    """Keys of a pydantic location without its union tags; the value there, and whether there is one."""
    keys: list[int | str] = []
    node, found = data, True
    for part in loc:
        if isinstance(node, list) and isinstance(part, str) and part.isdigit():
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


def _line(source: Any, keys: list[int | str]) -> tuple[int, int]:
    """How many of ``keys`` lead into a round-trip YAML mapping, and the line of the last of them; (0, 0) for none."""
    depth = line = 0
    node = source
    for key in keys:
        lines = getattr(getattr(node, "lc", None), "data", None)
        if not lines or key not in lines:
            break
        depth, line = depth + 1, lines[key][0] + 1
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
    near = difflib.get_close_matches(word, [str(k) for k in known], n=1, cutoff=0.6)
    return f"; did you mean {near[0]!r}?" if near else ""
