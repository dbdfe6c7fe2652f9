"""Runs of a sweep: variants × grid × samples, each identified by its variant and values."""

from __future__ import annotations

import itertools
import json
import math
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from dynsim.config.problems import OptionKey
from dynsim.errors import ScenarioError
from dynsim.scenario import Scenario, ScenarioFile
from dynsim.system.inputs import parse_yaml

# Maximum number of runs; a larger number is rejected as a mistake.
MAX_RUNS = 10_000_000
ANY = "*"

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER}):({_NUMBER}):(\d+)")
# Pattern of a range whose count is missing or not an integer.
_HALF_RANGE = re.compile(rf"({_NUMBER}):({_NUMBER})(:.*)?")
_LAW = re.compile(rf"(\w+)\(\s*({_NUMBER})\s*,\s*({_NUMBER})\s*\)")
# Distributions of samples, each with its two parameters.
LAWS = {"normal": "mean, standard deviation", "uniform": "minimum, maximum"}


@dataclass(frozen=True)
class Axis:
    """Scenario key and the values that it takes one after the other, from an option of the command line."""

    key: str
    values: tuple[Any, ...]
    option: str = "--grid"

    @classmethod
    def parse(cls, text: str, option: str = "--grid", default: int | None = None) -> Axis:
        """Parse ``KEY=start:stop:count``, both ends included, or ``KEY=a,b,…``; ``default`` is used without a count.

        Raises
        ------
        ScenarioError
            If the text has neither form, or its values are invalid.
        """
        key, value = _split(text, option, "contacts.friction=0:1:5 or contacts.friction=0,0.1")
        if default is not None and (match := _HALF_RANGE.fullmatch(value)) and match[3] is None:
            value = f"{value}:{default}"
        if match := _RANGE.fullmatch(value):
            start, stop, count = float(match[1]), float(match[2]), int(match[3])
            if not 2 <= count <= MAX_RUNS:
                raise ScenarioError(f"{option} {text}: count must be between 2 (both ends are included) and {MAX_RUNS}")
            # Round to twelve digits, to get 0.3 instead of 0.30000000000000004.
            return cls(key, tuple(float(f"{x:.12g}") for x in np.linspace(start, stop, count)), option)
        if match := _HALF_RANGE.fullmatch(value):
            example = f"{key}={match[1]}:{match[2]}:5"
            raise ScenarioError(f"{option} {text}: must be start:stop:count with an integer count, such as {example}")
        values = parse_yaml(f"[{value}]", ScenarioError, f"{option} {key}", line_numbers=False)
        if not values:
            raise ScenarioError(f"{option} {text}: has no values")
        if len(set(map(json.dumps, values))) < len(values):
            raise ScenarioError(f"{option} {text}: contains a value twice; remove one of them")
        return cls(key, tuple(values), option)


@dataclass(frozen=True)
class Law:
    """Scenario key and the distribution of its values; ``LAWS`` lists the two numbers of each distribution."""

    key: str
    name: str
    numbers: tuple[float, float]

    @classmethod
    def parse(cls, text: str) -> Law:
        """Parse ``KEY=normal(mean,deviation)`` or ``KEY=uniform(minimum,maximum)``.

        Raises
        ------
        ScenarioError
            If the text has neither form, or the spread is not positive.
        """
        key, value = _split(text, "--sample", "plant.link.mass_kg=normal(0.1,0.005)")
        match = _LAW.fullmatch(value)
        if not match or match[1] not in LAWS:
            known = ", ".join(f"{name}({numbers})" for name, numbers in LAWS.items())
            raise ScenarioError(f"--sample {text}: unknown distribution; choices: {known}")
        a, b = float(match[2]), float(match[3])
        if not (b > 0.0 if match[1] == "normal" else b > a):
            raise ScenarioError(f"--sample {text}: {match[1]}({LAWS[match[1]]}) requires a positive spread")
        if not (math.isfinite(a) and math.isfinite(b) and math.isfinite(b - a)):
            raise ScenarioError(f"--sample {text}: parameters and their difference must be finite")
        return cls(key, match[1], (a, b))

    def draw(self, key: str, seed: int, count: int) -> list[float]:
        """Draw values for one key, independently of other keys.

        A longer draw begins with the values of a shorter draw.
        """
        generator = np.random.default_rng([seed, zlib.crc32(key.encode())])
        a, b = self.numbers
        values = generator.normal(a, b, count) if self.name == "normal" else generator.uniform(a, b, count)
        return [float(value) for value in values]


@dataclass(frozen=True)
class SweepPoint:
    """One run of a sweep: its number, its variant, and the values that it changes, by dotted key."""

    run: int
    variant: str | None
    values: Mapping[str, Any]

    @property
    def identity(self) -> str:
        """Text that is the same for equal runs in two sweeps of the same scenario."""
        return json.dumps([self.variant, self.values], sort_keys=True)


@dataclass(frozen=True)
class Plan:
    """All runs of a sweep.

    Attributes
    ----------
    file : ScenarioFile
        The scenario.
    variants : tuple of str or None
        Variants to run; (None,) for a file without variants.
    overrides : mapping
        Overrides that apply to all runs.
    grid : tuple of Axis
        Keys whose values are combined with each other; ``*`` in a key matches all entries, which then have the same
        value.
    laws : tuple of Law
        Sampled keys, with the same samples at each grid point; ``*`` in a key matches all entries, which are sampled
        independently.
    count : int
        Number of samples at each grid point; 1 without laws.
    seed : int
        Seed of the samples.
    """

    file: ScenarioFile
    variants: tuple[str | None, ...]
    overrides: Mapping[str, Any] = field(default_factory=dict)
    grid: tuple[Axis, ...] = ()
    laws: tuple[Law, ...] = ()
    count: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.grid and not self.laws and len(self.variants) < 2:
            raise ScenarioError("nothing to sweep; add --grid, --sample or --variants")
        self._check_overlap()
        if self.count < 1:
            raise ScenarioError(f"--count {self.count}: must be 1 or more")
        if self.count > 1 and not self.laws:
            raise ScenarioError("--count requires --sample; without it all runs would be identical")
        if self.runs > MAX_RUNS:
            raise ScenarioError(f"too many runs ({self.runs}, limit {MAX_RUNS}); use fewer values")

    def _check_overlap(self) -> None:
        """Reject a key that replaces the value of an earlier key in every run: the same key, or a key that contains it.

        A key may vary a part of an earlier key: for example, ``plant.link`` is in a grid, and one of its numbers is
        sampled.
        """
        # Overrides from Python may be varied, because they only define the base of the sweep; a value from an option
        # must not change.
        options: list[tuple[str, str, list[str]]] = [
            (key.option, key, [key]) for key in self.overrides if isinstance(key, OptionKey)
        ]
        options += [(axis.option, axis.key, self._entries(axis.key)) for axis in self.grid]
        options += [("--sample", law.key, self._entries(law.key)) for law in self.laws]
        # Option that set each key; there is also an entry for every key that contains it.
        inside: dict[str, str] = {}
        for option, key, entries in options:
            # Later overrides replace earlier ones, as in every command.
            for entry in [] if isinstance(key, OptionKey) else entries:
                if (key_path := _plain(entry)) in inside:
                    other = inside[key_path]
                    fix = f", or replace {ANY} by the entries that are set only once" if ANY in key + other else ""
                    raise ScenarioError(
                        f"{option} {key}: replaces the value of {entry} from {other} in every run; "
                        f"remove one of the two{fix}"
                    )
            for key_path in map(_plain, entries):
                parts = key_path.split(".")
                inside |= {".".join(parts[:many]): f"{option} {key}" for many in range(1, len(parts) + 1)}

    @property
    def runs(self) -> int:
        """Number of runs."""
        return len(self.variants) * math.prod(len(axis.values) for axis in self.grid) * self.count

    @property
    def sampled(self) -> list[str]:
        """Keys that are sampled, with ``*`` expanded."""
        return [key for law in self.laws for key in self._entries(law.key)]

    @property
    def parameters(self) -> list[str]:
        """All keys that are varied, in the order of the table columns: first the grid, then the samples."""
        return [axis.key for axis in self.grid] + self.sampled

    @cached_property
    def first(self) -> Scenario:
        """Scenario of the first run."""
        return self.scenario(next(self.points()))

    def points(self) -> Iterator[SweepPoint]:
        """Yield all runs; variants are the outer loop, samples the inner loop."""
        drawn = {key: law.draw(key, self.seed, self.count) for law in self.laws for key in self._entries(law.key)}
        combinations = itertools.product(self.variants, *(axis.values for axis in self.grid), range(self.count))
        for run, (variant, *values, k) in enumerate(combinations):
            chosen = {axis.key: value for axis, value in zip(self.grid, values, strict=True)}
            yield SweepPoint(run, variant, chosen | {key: draws[k] for key, draws in drawn.items()})

    def scenario(self, point: SweepPoint) -> Scenario:
        """Return the scenario of a run.

        Raises
        ------
        ScenarioError
            If the values of the run do not result in a valid scenario.
        """
        values = {entry: value for key, value in point.values.items() for entry in self._entries(key)}
        return self.file.load(point.variant, {**self.overrides, **values})

    def _entries(self, key: str) -> list[str]:
        """Return the keys in the file, before variants are applied, that match a key with ``*``, or the key itself.

        Raises
        ------
        ScenarioError
            If ``*`` matches no entries.
        """
        parts = key.split(".")
        if ANY not in parts:
            return [key]
        nodes: list[tuple[list[str], Any]] = [([], self.file.data)]
        for part in parts:
            inner: list[tuple[list[str], Any]] = []
            for before, node in nodes:
                entries = _children(node)
                names = list(entries) if part == ANY else [part]
                inner += [([*before, name], entries.get(name)) for name in names]
            nodes = inner
        if not nodes:
            raise ScenarioError(f"{key}: {self.file.path} has no entries that match {ANY}")
        return [".".join(names) for names, _ in nodes]


def _plain(key: str) -> str:
    """Return a key with its list indices in plain form: 5 instead of 05."""
    return ".".join(part.lstrip("0") or "0" if part.isdecimal() else part for part in key.split("."))


def _children(node: Any) -> dict[str, Any]:
    if isinstance(node, Mapping):
        return {str(key): value for key, value in node.items()}
    if isinstance(node, Sequence) and not isinstance(node, str):
        return {str(k): value for k, value in enumerate(node)}
    return {}


def _split(text: str, option: str, example: str) -> tuple[str, str]:
    key, separator, value = text.partition("=")
    if not separator or not key.strip() or not value.strip():
        raise ScenarioError(f"{option} {text}: must look like {example}")
    return key.strip(), value.strip()
