"""Scenario files: search, merging of variants and overrides, validation, YAML output, and the JSON schema for editors.

Errors contain file, line, key and fix. A scenario file is a mapping; its key ``variants`` maps the name of each variant
to its differences (mappings merge, lists and values replace, null removes). Overrides are applied last.
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

from dynsim.config.problems import (
    INDEX,
    OptionKey,
    Origin,
    dotted,
    explain,
    key_text,
    overriding,
    suggest,
    unknown_keys,
    value_text,
)
from dynsim.errors import ScenarioError, brief
from dynsim.scenario.schema import Scenario, ScenarioConfig
from dynsim.system.arguments import names_wrong_types
from dynsim.system.files import check_complete
from dynsim.system.inputs import DEPTH_LIMIT, YamlMapping, is_file, parse_yaml, read_text
from dynsim.system.shipped import shipped_scenario, shipped_scenarios

# Keys of a file that do not belong to a single variant.
TOP = ("variants",)
# Smallest and largest magnitude of a number in a scenario, and the largest by the unit at the end of its key; the first
# match counts.
MAGNITUDE_MIN, MAGNITUDE_MAX = 1e-30, 1e15
MAGNITUDES = {
    "noise_deg": 360.0,
    "noise_rad": 6.3,
    "noise_m": 10.0,
    "resolution_deg": 360.0,
    "resolution_m": 10.0,
    "delay_s": 60.0,
    "_kg_m2": 1e12,
    "_N_per_m": 1e15,
    "_N_m_per_rad": 1e15,
    "_per_rad": 1e9,
    "_per_m": 1e12,
    "_kg": 1e9,
    "_N_m": 1e9,
    "_m": 1e6,
    "_deg": 1e6,
    "_rad": 1e5,
    "_H": 1e6,
    "_N": 1e9,
    "_s": 1e9,
    "_s2": 1e9,
    "_V": 1e9,
    "_A": 1e9,
    "_hz": 1e9,
}
# Maximum number of other variants in which unknown keys are sought after an error.
VARIANTS_SEARCHED = 100


def find_scenario(name: str | Path) -> Path:
    """Return the path of a scenario file, given its path or the name of a shipped scenario.

    Raises
    ------
    ScenarioError
        If neither exists (the message suggests similar names), or if the path is a folder.
    RecordError
        If the file belongs to a run that was killed while its results were saved.
    """
    if not isinstance(name, (str, Path)):
        raise ScenarioError(f"expected a scenario file or the name of a shipped scenario, got {brief(name)}")
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
    """Return the names of the variants in a scenario file, in file order; empty without variants."""
    return read_scenario(path).variants


@names_wrong_types
def load_scenario(path: str | Path, variant: str | None = None, overrides: Mapping[str, Any] | None = None) -> Scenario:
    """Load and validate one variant of a scenario.

    Parameters
    ----------
    path : str or Path
        Path of a scenario file, or the name of a shipped scenario (see ``dynsim list``).
    variant : str, optional
        Name of the variant; default: the first variant in the file.
    overrides : mapping, optional
        Values by dotted key, in the units stated in the keys, e.g.
        ``{"integrator.rtol": 1e-8, "plant.chain.0.mass_kg": 0.2}``. They are applied after the variant.

    Returns
    -------
    Scenario
        Validated scenario with all defaults.

    Raises
    ------
    ScenarioError
        If the file, the variant or a key does not exist, or a value is invalid. The message contains file, line, key,
        value and fix.

    Examples
    --------
    >>> import dynsim
    >>> scenario = dynsim.load_scenario("elbow_comparison", variant="elbow_4", overrides={"duration_s": 2.0})
    >>> scenario.variant, scenario.duration_s
    ('elbow_4', 2.0)
    """
    return read_scenario(path).load(variant, overrides)


def read_scenario(path: str | Path) -> ScenarioFile:
    """Read a scenario file, or a shipped scenario, without validating it.

    Raises
    ------
    ScenarioError
        If the file cannot be read or is not a mapping.
    """
    path = find_scenario(path)
    return ScenarioFile(path, _read(path))


@dataclass(frozen=True)
class ScenarioFile:
    """Content of a scenario file, from which scenarios can be loaded without reading the file again.

    Attributes
    ----------
    path : Path
        Path of the file; paths in the scenario are relative to its folder.
    data : YamlMapping
        Content with line numbers.
    """

    path: Path
    data: YamlMapping

    @property
    def variants(self) -> list[str]:
        """Names of the variants, in file order; empty without variants."""
        variants = self.data.get("variants")
        return list(variants) if isinstance(variants, Mapping) else []

    def load(self, variant: str | None = None, overrides: Mapping[str, Any] | None = None) -> Scenario:
        """Load and validate one variant; see :func:`load_scenario`."""
        variants, variant = self.chosen(variant)
        overrides = {} if overrides is None else overrides
        if not (isinstance(overrides, Mapping) and all(isinstance(key, str) for key in overrides)):
            raise ScenarioError(
                f"overrides must map dotted keys to values, e.g. {{'integrator.rtol': 1e-8}}, got {brief(overrides)}"
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
        """Return all variants and the name of the chosen variant (None without variants).

        Raises
        ------
        ScenarioError
            If the variant does not exist.
        """
        path, data = self.path, self.data
        variants = data.get("variants")
        if variants is None:
            variants = {}
        if not isinstance(variants, Mapping):
            raise ScenarioError(f"{path}:{data.lines['variants']}: variants must be a mapping of names to differences")
        if variant is None and variants:
            variant = next(iter(variants))
        # Compare with a list, because an invalid name may not be hashable.
        if variant is not None and variants and variant not in list(variants):
            raise ScenarioError(
                f"{path}: no variant {variant!r}{suggest(str(variant), variants)}; "
                f"variants: {', '.join(map(key_text, variants))}"
            )
        if variant is not None and not variants and variant != data.get("variant"):
            raise ScenarioError(f"{path}: has no variants; remove the variant {variant!r}")
        return variants, variant

    def _merged(self, variant: str | None, overrides: Mapping[str, Any]) -> tuple[dict[str, Any], Origin]:
        """Return one variant with overrides applied, and the origin of its values."""
        shared = YamlMapping()
        shared.update({key: value for key, value in self.data.items() if key != "variants"})
        shared.lines = {key: line for key, line in self.data.lines.items() if key in shared}
        variants: Any = self.data.get("variants")
        difference: Any = variants.get(variant) if variants and variant is not None else None
        if difference is None:
            difference = {}
        if not isinstance(difference, Mapping):
            line = f":{variants.lines[variant]}" if isinstance(variants, YamlMapping) and variant is not None else ""
            raise ScenarioError(f"{self.path}{line}: variant {value_text(variant)} must be a mapping of differences")
        origin = Origin(self.path, (difference, shared), tuple(overrides))
        merged = _plain(merged_with(shared, difference))
        for key, value in overrides.items():
            _override(merged, key, _plain(value), variant)
        if merged.get("name") in (None, ""):
            merged["name"] = self.path.stem
        if variant is not None:
            merged["variant"] = variant
        _make_absolute(merged, self.path.parent)
        _check_sizes(merged, (), origin)
        return merged, origin

    def _unknown_keys(self, variant: str, overrides: Mapping[str, Any]) -> list[str]:
        """Return the unknown keys of a variant; an empty list if it has other errors."""
        try:
            merged, origin = self._merged(variant, overrides)
            ScenarioConfig.model_validate(merged)
        except ScenarioError:
            return []
        except ValidationError as error:
            return unknown_keys(error, merged, origin, ScenarioConfig, TOP)
        return []


def scenario_from_resolved(resolved: Mapping[str, Any]) -> Scenario:
    """Return the scenario in a record's provenance.

    Raises
    ------
    ScenarioError
        If the record was written by a version of dynsim with different keys.
    """
    if not isinstance(resolved, Mapping):
        raise ScenarioError(f"the scenario in this record must be a mapping of keys to values, got {brief(resolved)}")
    try:
        config = ScenarioConfig.model_validate(resolved)
    except ValidationError as error:
        origin = Origin("the scenario in this record")
        problem = explain(error, resolved, origin, unknown_keys(error, resolved, origin, ScenarioConfig, TOP))
        raise ScenarioError(f"{problem}; the record was written by another version of dynsim") from None
    return Scenario(config.name, config.variant, config)


def parse_override(text: str, option: str = "--set", inside: str = "") -> tuple[str, Any]:
    """Split ``a.b.c=VALUE``, the value of a command-line option, into the key and the YAML value.

    The key starts with ``inside``. Errors refer to it with the name of the option.

    Raises
    ------
    ScenarioError
        If the text has no ``=``, or the value is not valid YAML.
    """
    key, separator, value = text.partition("=")
    key = key.strip()
    if not separator or not key:
        example = "rating_share=1" if inside else "integrator.rtol=1e-8"
        raise ScenarioError(f"{option} {key_text(text)}: must look like {example}")
    number = _plain(parse_yaml(value, ScenarioError, f"{option} {key_text(key)}", line_numbers=False))
    return OptionKey(f"{inside}{key}", option), number


def _read(path: Path) -> YamlMapping:
    data = parse_yaml(read_text(path, ScenarioError), ScenarioError, str(path))
    if data is None:
        raise ScenarioError(f"{path}: is empty; a scenario requires at least duration_s and plant")
    if not isinstance(data, YamlMapping):
        kind = "list" if isinstance(data, list) else "single value"
        raise ScenarioError(f"{path}: must be a mapping of keys to values, not a {kind}")
    return data


def _plain(value: Any) -> Any:
    """Return a copy in plain Python types; arrays, which overrides may contain, become lists."""
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


def merged_with(base: Any, difference: Any) -> Any:
    """Merge ``difference`` into ``base``: mappings merge, null removes, other values replace."""
    if not (isinstance(base, Mapping) and isinstance(difference, Mapping)):
        return difference
    merged = {key: merged_with(value, {}) if isinstance(value, Mapping) else value for key, value in base.items()}
    for key, value in difference.items():
        if value is None:
            merged.pop(key, None)
        else:
            merged[key] = merged_with(merged.get(key), value)
    return merged


def _override(data: Any, key: str, value: Any, variant: str | None) -> None:
    """Set the dotted ``key`` in nested mappings and lists."""
    node, parts = data, str(key).split(".")
    location = f"{overriding(key)} {key_text(key)}"
    if "" in parts:
        raise ScenarioError(f"{location}: part of the key is empty; write it like integrator.rtol")
    if len(parts) > DEPTH_LIMIT:
        raise ScenarioError(f"{location}: has {len(parts)} parts; keys must not have more than {DEPTH_LIMIT}")
    if parts[0] == "variants" or (parts[0] == "variant" and variant is not None):
        raise ScenarioError(f"{location}: the variant cannot be set here; use dynsim run --variant")
    for depth, part in enumerate(parts):
        last = depth == len(parts) - 1
        if isinstance(node, list):
            if not INDEX.fullmatch(part) or int(part) >= len(node):
                raise ScenarioError(f"{location}: {value_text(part)} is not an index of a list of {len(node)} entries")
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
    """Resolve the paths in keys named ``file`` relative to the scenario's folder."""
    if isinstance(data, dict):
        for key, value in data.items():
            if key == "file" and isinstance(value, str):
                # The reader of the file reports invalid file names.
                with suppress(OSError, ValueError, RuntimeError):
                    data[key] = str((folder / value).resolve())
            else:
                _make_absolute(value, folder)
    elif isinstance(data, list):
        for item in data:
            _make_absolute(item, folder)


def _check_sizes(value: Any, keys: tuple[int | str, ...], origin: Origin, largest: float = MAGNITUDE_MAX) -> None:
    """Reject numbers that are no physical quantities; other checks reject NaN and infinity."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            # Below a key with a unit there may be names of joints and bodies, and indices.
            limit = largest_magnitude(key, largest) if isinstance(key, str) else largest
            _check_sizes(item, (*keys, key), origin, limit)
    elif (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and 0 < abs(value) < np.inf
        and not MAGNITUDE_MIN <= abs(value) <= largest
    ):
        raise ScenarioError(
            f"{origin.location(keys)}: {dotted(keys)} = {value_text(value)}: the magnitude must be between "
            f"{MAGNITUDE_MIN:g} and {largest:g}, or zero"
        )


def largest_magnitude(key: str, default: float = MAGNITUDE_MAX) -> float:
    """Return the largest magnitude of numbers under a key with a unit, otherwise ``default``."""
    return next((largest for unit, largest in MAGNITUDES.items() if key.endswith(unit)), default)


def to_yaml(resolved: Mapping[str, Any]) -> str:
    """Return a resolved scenario as YAML text."""
    from ruamel.yaml import YAML

    stream = io.StringIO()
    yaml: Any = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False
    yaml.dump(dict(resolved), stream)
    return stream.getvalue()


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of scenario files for editors; the content of ``variants`` is not checked."""
    schema = _by_type(ScenarioConfig.model_json_schema())
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["properties"]["variants"] = {
        "type": "object",
        "description": "differences by variant name (mappings merge, lists and values replace, null removes)",
        "additionalProperties": {"type": ["object", "null"]},
    }
    return schema


def _by_type(schema: Any) -> Any:
    """Rewrite choices as conditions on ``type`` and null; editors report ``oneOf`` and ``anyOf`` only as "no match"."""
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
