"""Reading of scenario files: search, merging of variant and overrides, validation, and writing of resolved scenarios.

Errors name file, line, key and fix. A scenario file is one mapping; ``variants`` holds the differences of each variant
by its name (mappings merge, lists and values replace, null removes). Overrides are applied last.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from dynsim.config.problems import INDEX, Origin, dotted, explain, key_text, suggest, unknown_keys, value_text
from dynsim.errors import ScenarioError, brief
from dynsim.scenario.schema import Scenario, ScenarioConfig
from dynsim.system.files import check_complete
from dynsim.system.inputs import DEPTH_LIMIT, YamlMapping, is_file, parse_yaml, read_text
from dynsim.system.shipped import shipped_scenario, shipped_scenarios

# Keys of a file that are not part of one variant.
TOP = ("variants",)
# Largest magnitude of a number in a scenario, in any unit.
SIZE_MAX = 1e30
# Variants that are searched for further unknown keys once one was found.
VARIANTS_SEARCHED = 100


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
        raise ScenarioError(f"a scenario is named by its file, or by its name when it is shipped, not by {brief(name)}")
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
    raise ScenarioError(f"{name}: no such file{suggest(path.stem, names)}; shipped scenarios: {', '.join(names)}")


def variant_names(path: str | Path) -> list[str]:
    """Names of the variants in a scenario file, in its order; empty without variants."""
    return read_scenario(path).variants


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
    return read_scenario(path).load(variant, overrides)


def read_scenario(path: str | Path) -> ScenarioFile:
    """Read a scenario file, or the shipped scenario of that name, without validating it.

    Raises
    ------
    ScenarioError
        It cannot be read, or is no mapping.
    """
    path = find_scenario(path)
    return ScenarioFile(path, _read(path))


@dataclass(frozen=True)
class ScenarioFile:
    """A scenario file as it was read: many scenarios can be loaded from it, also in processes that do not have it.

    Attributes
    ----------
    path : where it was read from; files that it names are relative to its folder
    data : its content
    """

    path: Path
    data: YamlMapping

    @property
    def variants(self) -> list[str]:
        """Names of the variants, in the order of the file; empty without variants."""
        variants = self.data.get("variants")
        return list(variants) if isinstance(variants, Mapping) else []

    def load(self, variant: str | None = None, overrides: Mapping[str, Any] | None = None) -> Scenario:
        """See :func:`load_scenario`."""
        variants, variant = self.chosen(variant)
        overrides = {} if overrides is None else overrides
        if not (isinstance(overrides, Mapping) and all(isinstance(key, str) for key in overrides)):
            raise ScenarioError(
                f"overrides must map dotted keys to values, as {{'integrator.rtol': 1e-8}} does, not {brief(overrides)}"
            )
        merged, origin = self._merged(variant, overrides)
        try:
            config = ScenarioConfig.model_validate(merged)
        except ValidationError as error:
            unknown = unknown_keys(error, merged, origin, ScenarioConfig, TOP)
            if unknown:
                for other in [name for name in itertools.islice(variants, VARIANTS_SEARCHED) if name != variant]:
                    unknown += self._unknown_keys(other, overrides)
            raise ScenarioError(explain(error, merged, origin, unknown)) from None
        return Scenario(config.name, config.variant, config, self.path, origin)

    def chosen(self, variant: str | None) -> tuple[Mapping[str, Any], str | None]:
        """All variants, and the name of the one that is meant, None without any; ScenarioError if there is no such."""
        path, data = self.path, self.data
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
                f"{path}: no variant {variant!r}{suggest(str(variant), variants)}; "
                f"variants: {', '.join(map(key_text, variants))}"
            )
        if variant is not None and not variants and variant != data.get("variant"):
            raise ScenarioError(f"{path}: has no variants, so there is no {variant!r}")
        return variants, variant

    def _merged(self, variant: str | None, overrides: Mapping[str, Any]) -> tuple[dict[str, Any], Origin]:
        """One variant of a file with overrides on top, and where its values come from."""
        shared = YamlMapping()
        shared.update({key: value for key, value in self.data.items() if key != "variants"})
        shared.lines = {key: line for key, line in self.data.lines.items() if key in shared}
        variants: Any = self.data.get("variants")
        difference: Any = variants.get(variant) if variants and variant is not None else None
        if difference is None:
            difference = {}
        if not isinstance(difference, Mapping):
            line = f":{variants.lines[variant]}" if isinstance(variants, YamlMapping) and variant is not None else ""
            raise ScenarioError(f"{self.path}{line}: variant {value_text(variant)} must be a mapping of what differs")
        overriding = "--set" if isinstance(overrides, SetOptions) else "overrides"
        origin = Origin(self.path, (difference, shared), tuple(overrides), overriding)
        merged = _plain(_merge(shared, difference))
        for key, value in overrides.items():
            _override(merged, key, _plain(value), overriding, variant)
        if merged.get("name") in (None, ""):
            merged["name"] = self.path.stem
        if variant is not None:
            merged["variant"] = variant
        _make_absolute(merged, self.path.parent)
        _check_sizes(merged, (), origin)
        return merged, origin

    def _unknown_keys(self, variant: str, overrides: Mapping[str, Any]) -> list[str]:
        """Unknown keys of a variant; nothing when it has other faults."""
        try:
            merged, origin = self._merged(variant, overrides)
            ScenarioConfig.model_validate(merged)
        except ScenarioError:
            return []
        except ValidationError as error:
            return unknown_keys(error, merged, origin, ScenarioConfig, TOP)
        return []


def scenario_from_resolved(resolved: Mapping[str, Any]) -> Scenario:
    """The scenario that a record's provenance holds.

    Raises
    ------
    ScenarioError
        It was written by a version of dynsim with other keys.
    """
    if not isinstance(resolved, Mapping):
        raise ScenarioError(f"the scenario in this record must be a mapping of keys to values, not {brief(resolved)}")
    try:
        config = ScenarioConfig.model_validate(resolved)
    except ValidationError as error:
        origin = Origin("the scenario in this record")
        problem = explain(error, resolved, origin, unknown_keys(error, resolved, origin, ScenarioConfig, TOP))
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
        raise ScenarioError(f"--set {key_text(text)}: must look like integrator.rtol=1e-8")
    return key, _plain(parse_yaml(value, ScenarioError, f"--set {key_text(key)}", line_numbers=False))


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
    location = f"{overriding} {key_text(key)}"
    if "" in parts:
        raise ScenarioError(f"{location}: a part of the key is empty; it must look like integrator.rtol")
    if len(parts) > DEPTH_LIMIT:
        raise ScenarioError(f"{location}: has {len(parts)} parts; no key of a scenario has more than {DEPTH_LIMIT}")
    if parts[0] == "variants" or (parts[0] == "variant" and variant is not None):
        raise ScenarioError(f"{location}: which variant runs is chosen by its name (dynsim run --variant), not set")
    for depth, part in enumerate(parts):
        last = depth == len(parts) - 1
        if isinstance(node, list):
            if not INDEX.fullmatch(part) or int(part) >= len(node):
                raise ScenarioError(f"{location}: {value_text(part)} is no index of a list of {len(node)}")
            index: Any = int(part)
        elif isinstance(node, Mapping):
            index = part
        else:
            raise ScenarioError(f"{location}: {dotted(parts[:depth])} is a value, not a mapping")
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


def _check_sizes(value: Any, keys: tuple[int | str, ...], origin: Origin) -> None:
    """Refuse numbers whose powers and products leave the range of a float; other checks see to NaN and infinity."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            _check_sizes(item, (*keys, key), origin)
    elif isinstance(value, int | float) and (SIZE_MAX < abs(value) < np.inf or 0 < abs(value) < 1.0 / SIZE_MAX):
        raise ScenarioError(
            f"{origin.location(keys)}: {dotted(keys)} = {value_text(value)}: its size must be between "
            f"{1.0 / SIZE_MAX:g} and {SIZE_MAX:g}, or zero"
        )


def to_yaml(resolved: Mapping[str, Any]) -> str:
    """YAML text of a resolved scenario."""
    from ruamel.yaml import YAML

    stream = io.StringIO()
    yaml: Any = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False
    yaml.dump(dict(resolved), stream)
    return stream.getvalue()


# The JSON schema of scenario files, for editors.


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
