"""Runs of a sweep: variants × grid × samples, each identified by its variant and values."""

from __future__ import annotations

import itertools
import json
import math
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dynsim.errors import ScenarioError
from dynsim.scenario import Scenario, ScenarioFile, SetOptions
from dynsim.system.inputs import parse_yaml

# More runs than this are refused as a mistake.
RUNS_MOST = 10_000_000
ANY = "*"

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER}):({_NUMBER}):(\d+)")
# A range without its count, or with one that is no whole number.
_HALF_RANGE = re.compile(rf"({_NUMBER}):({_NUMBER})(:.*)?")
_LAW = re.compile(rf"(\w+)\(\s*({_NUMBER})\s*,\s*({_NUMBER})\s*\)")
# Distributions of samples, and the meanings of their two numbers.
LAWS = {"normal": "mean, standard deviation", "uniform": "least, greatest"}


@dataclass(frozen=True)
class Axis:
    """A key of the scenario and the values that it takes one after the other."""

    key: str
    values: tuple[Any, ...]

    @classmethod
    def parse(cls, text: str) -> Axis:
        """``KEY=start:stop:count``, both ends included, or ``KEY=a,b,…``.

        Raises
        ------
        ScenarioError
            Neither of them.
        """
        key, value = _split(text, "--grid", "contacts.friction=0:1:5 or contacts.friction=0,0.1")
        if match := _RANGE.fullmatch(value):
            start, stop, count = float(match[1]), float(match[2]), int(match[3])
            if not 2 <= count <= RUNS_MOST:
                raise ScenarioError(
                    f"--grid {text}: the count must be 2 or more, as both ends are included, and at most {RUNS_MOST}"
                )
            # Twelve digits: 0.3 and not 0.30000000000000004.
            return cls(key, tuple(float(f"{x:.12g}") for x in np.linspace(start, stop, count)))
        if match := _HALF_RANGE.fullmatch(value):
            example = f"{key}={match[1]}:{match[2]}:5"
            raise ScenarioError(f"--grid {text}: must be start:stop:count with a whole count, such as {example}")
        values = parse_yaml(f"[{value}]", ScenarioError, f"--grid {key}", line_numbers=False)
        if not values:
            raise ScenarioError(f"--grid {text}: has no values")
        if len(set(map(json.dumps, values))) < len(values):
            raise ScenarioError(f"--grid {text}: has a value twice")
        return cls(key, tuple(values))


@dataclass(frozen=True)
class Law:
    """A key of the scenario and the law that its values are drawn by: see ``LAWS`` for what the two numbers are."""

    key: str
    name: str
    numbers: tuple[float, float]

    @classmethod
    def parse(cls, text: str) -> Law:
        """``KEY=normal(mean,deviation)`` or ``KEY=uniform(least,greatest)``.

        Raises
        ------
        ScenarioError
            None of them, or a spread that is not positive.
        """
        key, value = _split(text, "--sample", "plant.link.mass_kg=normal(0.1,0.005)")
        match = _LAW.fullmatch(value)
        if not match or match[1] not in LAWS:
            known = ", ".join(f"{name}({numbers})" for name, numbers in LAWS.items())
            raise ScenarioError(f"--sample {text}: no law of that form; laws: {known}")
        a, b = float(match[2]), float(match[3])
        if not (b > 0.0 if match[1] == "normal" else b > a):
            raise ScenarioError(f"--sample {text}: {match[1]}({LAWS[match[1]]}) needs a spread that is positive")
        if not (math.isfinite(a) and math.isfinite(b) and math.isfinite(b - a)):
            raise ScenarioError(f"--sample {text}: numbers of that size cannot be drawn")
        return cls(key, match[1], (a, b))

    def draw(self, key: str, seed: int, count: int) -> list[float]:
        """Values for one key, the same whatever else is drawn; a longer draw begins like a shorter one."""
        generator = np.random.default_rng([seed, zlib.crc32(key.encode())])
        a, b = self.numbers
        values = generator.normal(a, b, count) if self.name == "normal" else generator.uniform(a, b, count)
        return [float(value) for value in values]


@dataclass(frozen=True)
class SweepPoint:
    """One run: its number, its variant, and what it changes by dotted key."""

    run: int
    variant: str | None
    values: Mapping[str, Any]

    @property
    def identity(self) -> str:
        """The same for the same run of another sweep of the same scenario."""
        return json.dumps([self.variant, self.values], sort_keys=True)


@dataclass(frozen=True)
class Plan:
    """All runs of a sweep.

    Attributes
    ----------
    file : the scenario
    variants : to run; None for the only one of a file without any
    overrides : for all runs
    grid : every value of one with every value of the others; ``*`` in a key stands for all entries, which share it
    laws : samples, the same at each place of the grid; ``*`` in a key stands for all entries, each drawn by itself
    count : samples of each place; 1 without laws
    seed : of the samples
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
            raise ScenarioError("nothing to sweep: give --grid, --sample or --variants")
        self._check_overlap()
        if self.count < 1:
            raise ScenarioError(f"--count {self.count}: must be 1 or more")
        if self.count > 1 and not self.laws:
            raise ScenarioError("--count is how often --sample draws; without one all runs would be the same")
        if self.runs > RUNS_MOST:
            raise ScenarioError(f"{self.runs} runs: more than {RUNS_MOST}; take fewer values")

    def _check_overlap(self) -> None:
        """Refuse a key that replaces in every run what an earlier one gave, the same or a part of it.

        A part of what an earlier key gave may well be varied: ``plant.link`` by a grid, one of its numbers by a sample.
        """
        # In Python they are a base, of values that may well be varied; who writes --set wants that value.
        overrides = self.overrides if isinstance(self.overrides, SetOptions) else {}
        options = [("--set", key, [key]) for key in overrides]
        options += [("--grid", axis.key, self._entries(axis.key)) for axis in self.grid]
        options += [("--sample", law.key, self._entries(law.key)) for law in self.laws]
        # What was given, by itself and by all that it is a part of.
        inside: dict[str, str] = {}
        for option, key, entries in options:
            # Later overrides replace earlier ones, as in every command.
            for entry in entries if option != "--set" else []:
                if (key_path := _plain(entry)) in inside:
                    other = inside[key_path]
                    fix = f", or write out the entries of {ANY} that the other leaves" if ANY in key + other else ""
                    raise ScenarioError(
                        f"{option} {key}: replaces what {other} gives {entry}, in every run; "
                        f"take one of the two away{fix}"
                    )
            for key_path in map(_plain, entries):
                parts = key_path.split(".")
                inside |= {".".join(parts[:many]): f"{option} {key}" for many in range(1, len(parts) + 1)}

    @property
    def runs(self) -> int:
        """How many there are."""
        return len(self.variants) * math.prod(len(axis.values) for axis in self.grid) * self.count

    @property
    def sampled(self) -> list[str]:
        """Keys that are drawn, ``*`` written out."""
        return [key for law in self.laws for key in self._entries(law.key)]

    @property
    def parameters(self) -> list[str]:
        """All keys that are varied, those of the grid first, as the columns of the table have them."""
        return [axis.key for axis in self.grid] + self.sampled

    def points(self) -> Iterator[SweepPoint]:
        """All runs: variants outermost, samples innermost."""
        drawn = {key: law.draw(key, self.seed, self.count) for law in self.laws for key in self._entries(law.key)}
        places = itertools.product(self.variants, *(axis.values for axis in self.grid), range(self.count))
        for run, (variant, *values, k) in enumerate(places):
            chosen = {axis.key: value for axis, value in zip(self.grid, values, strict=True)}
            yield SweepPoint(run, variant, chosen | {key: draws[k] for key, draws in drawn.items()})

    def scenario(self, point: SweepPoint) -> Scenario:
        """What one run simulates.

        Raises
        ------
        ScenarioError
            Its values do not make a scenario.
        """
        values = {entry: value for key, value in point.values.items() for entry in self._entries(key)}
        return self.file.load(point.variant, {**self.overrides, **values})

    def _entries(self, key: str) -> list[str]:
        """Keys that one with ``*`` stands for, by what the file has before its variants; the key itself without.

        Raises
        ------
        ScenarioError
            The file has no entries there.
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
            raise ScenarioError(f"{key}: {self.file.path} has no entries that {ANY} could stand for")
        return [".".join(names) for names, _ in nodes]


def _plain(key: str) -> str:
    """A key with numbers of entries as they are counted: 5 for 05."""
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
