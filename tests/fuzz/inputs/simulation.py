"""Simulations of shipped scenarios with values near the shipped ones, by family of robots; most of them run."""

from __future__ import annotations

import copy
import json
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from fuzz.case import SHIPPED, Draft
from fuzz.inputs.override import losses as override_losses
from fuzz.inputs.override import path_of
from fuzz.inputs.scenario import OLD
from fuzz.mutations import at, options, vary, yaml_text
from fuzz.readings import loaded, merged, scenario_losses, yaml_tree

FAMILIES = {
    "arm": ("elbow_comparison", "single_pendulum", "link_tolerance", "thirty_links", "elbow_comparison_vertical"),
    "braced_arm": (
        "elbow_comparison_floor", "elbow_comparison_links", "soft_floor", "bouncing_link", "brace_on_cylinder",
        "brace_on_shapes", "floor_below", "falling_arm", "pressing", "block_on_slope",
    ),
    "mobile_arm": (
        "mobile_elbow_comparison", "mobile_elbow_comparison_driving", "mobile_path", "mobile_reach", "mobile_turns",
    ),
    "urdf_arm": ("six_axis_arm", "free_flyer"),
    "loads": ("wall_push", "spring_drawer", "soft_floor", "free_flyer"),
    "sensors": ("sampled_arm", "snake_positioning_dynamic"),
    "snake": (
        "snake_circle", "snake_circle_backward", "snake_door_arc", "snake_joint_limits", "snake_operator",
        "snake_positioning", "snake_short",
    ),
    "dynamic_snake": ("snake_positioning_dynamic", "snake_push", "snake_pull"),
    "gripper": ("snake_pick_up", "snake_valve", "snake_door"),
}  # fmt: skip
FAMILIES["set_value"] = tuple(name for names in list(FAMILIES.values())[:-2] for name in names)
# Settings that fit other scenarios as well.
EXTRA = (
    "integrator.method=dopri5", "integrator.method=radau5", "integrator.method=time_stepping", "integrator.rtol=1e-8",
    "integrator.solver=m_star", "contacts.law=unilateral", "contacts.friction=0.4", "integrator.theta=0.7",
    "sensors.encoders.rate_hz=100", "sensors.encoders.delay_s=0.01", "sensors.encoders.noise_deg=0.05",
    "sensors.seed=7", "initial.equilibrium=true", "surface_error.friction_factor=0.8", "integrator.step_max_s=0.001",
    "mass_error.robot_factor=1.2",
)  # fmt: skip
QUIET = ("--no-figures", "--quiet")


@cache
def tree_of(name: str) -> Any:
    """Return a shipped scenario as a tree, short enough to run."""
    tree = yaml_tree((SHIPPED / f"{name}.yaml").read_text(encoding="utf-8"))
    tree["duration_s"] = 0.02 if name.startswith("snake") else 0.05
    return tree


def varied(rng: Random, name: str, count: int) -> tuple[Any, str]:
    """Return one variant of a shipped scenario with ``count`` values changed, and a description."""
    tree = copy.deepcopy(tree_of(name))
    variants = tree.pop("variants", None) or {}
    variant = rng.choice([*variants] or [""])
    tree = merged(tree, variants.get(variant) or {})
    for other in variants.values():
        # The controller and the reference of a variant may need its duration.
        if other and "duration_s" in other:
            tree["duration_s"] = tree_of(name)["duration_s"]
    keys = [key for _ in range(count) if (key := vary(rng, tree))]
    return tree, f"{name} {variant}: {', '.join(f'{key} = {at(tree, path_of(key))}' for key in keys)}"


def draw(rng: Random, records: Path, kind: str) -> Draft:
    name = rng.choice(FAMILIES[kind])
    if kind == "set_value":
        return _with_options(rng, name)
    tree, mutation = varied(rng, name, rng.choice((0, 1, 1, 2, 3)))
    if rng.random() < 0.1:
        tree["duration_s"] = rng.choice((1e-3, 0.11, 0.2))
    arguments = _set(rng.sample(EXTRA, 1)) if rng.random() < 0.3 else []
    commands = [["run", "scenario.yaml", *QUIET, "--out", "out", *arguments]]
    again = rng.random() < 0.1
    if again:
        commands.append(["run", "out/scenario.yaml", *QUIET, "--out", "again"])
    files = {"scenario.yaml": yaml_text(tree).encode(), **OLD}
    return Draft(f"{mutation} {' '.join(arguments)}", files, commands, partial(losses, arguments[1::2], again))


def _with_options(rng: Random, name: str) -> Draft:
    """Return a case of values that are set on the command line."""
    tree, _ = varied(rng, name, 0)
    changed = copy.deepcopy(tree)
    keys = {key for _ in range(rng.choice((1, 2, 3))) if (key := vary(rng, changed))}
    overrides = [f"{key}={yaml_text(at(changed, path_of(key))).strip()}" for key in sorted(keys)]
    if rng.random() < 0.3:
        key = rng.choice([key for key in ("method", "solver", "law", "pulling_friction") if key in options()])
        section = "contacts" if key in ("law", "pulling_friction") else "integrator"
        overrides.append(f"{section}.{key}={rng.choice(options()[key])}")
    command = rng.choice((["check", "scenario.yaml"], ["run", "scenario.yaml", *QUIET, "--out", "out"]))
    files: dict[str, bytes | str] = {"scenario.yaml": yaml_text(tree).encode()}
    return Draft(
        f"{name}: {'; '.join(overrides)}", files, [[*command, *_set(overrides)]], partial(override_losses, overrides)
    )


def _set(overrides: list[str]) -> list[str]:
    return [word for text in overrides for word in ("--set", text)]


def losses(overrides: list[str], again: bool) -> list[str]:
    """Return values that the scenario lacks, faults of the files of the run, and differences of its repetition."""
    from dynsim.errors import RecordError
    from dynsim.record import Record
    from dynsim.scenario import load_scenario, parse_override

    scenario = load_scenario("scenario.yaml", None, dict(map(parse_override, overrides)))
    tree = yaml_tree(Path("scenario.yaml").read_text(encoding="utf-8"))
    for key, item in map(parse_override, overrides):
        tree = merged(tree, _nested(key, item))
    lost = scenario_losses(tree, scenario)
    if Path("out/record.h5").read_bytes() == OLD["out/record.h5"]:
        raise RecordError("refused")
    lost += _not_json(Path("out/summary.json"))
    record = loaded(Path("out/record.h5"))
    if record.complete and not np.isclose(record.time[-1], scenario.duration_s, rtol=1e-9):
        lost.append(f"a complete record ends at {record.time[-1]}, not {scenario.duration_s}")
    if again and Path("again").exists():
        repeated = Record.load("again/record.h5")
        lost += [f"signal {name} of the repetition differs" for name in record if not _same(record, repeated, name)]
    return lost


def _nested(key: str, item: Any) -> Any:
    for part in reversed(key.split(".")):
        item = {part: item}
    return item


def _same(record: Any, other: Any, name: str) -> bool:
    return name in other and np.array_equal(record[name], other[name], equal_nan=record[name].dtype.kind == "f")


def _not_json(path: Path) -> list[str]:
    """Return a fault if a file is not JSON of finite numbers."""

    def refuse(constant: str) -> None:
        raise ValueError(constant)

    try:
        json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    except ValueError as error:
        return [f"{path} is not JSON: {error}"]
    return []
