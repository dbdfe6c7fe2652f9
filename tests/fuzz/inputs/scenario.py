"""Scenario files: shipped files with damaged keys, values, words and bytes."""

from __future__ import annotations

from pathlib import Path
from random import Random
from typing import Any

from fuzz.case import SHIPPED, Draft
from fuzz.mutations import mutate_text, mutate_tree, yaml_text
from fuzz.readings import merged, scenario_losses, yaml_tree

# Scenarios and their weights in the draw.
NAMES = (
    "elbow_comparison",
    "single_pendulum",
    "six_axis_arm",
    "thirty_links",
    "snake_positioning",
    "snake_operator",
    "snake_joint_limits",
)
WEIGHTS = (6, 6, 1, 2, 1, 2, 1)
# Settings of a short run, so that its work does not depend on the draw.
SHORT = (
    "duration_s=0.01",
    "record.rate_hz=1000",
    "record.size_limit_GB=1",
    "metrics.settle_s=0",
    "integrator.step_s=null",
    "integrator.step_max_s=null",
)
OLD = {"out/record.h5": b"an older record", "out/summary.json": b"{}", "out/scenario.yaml": b"older: true"}


def draw(rng: Random, records: Path) -> Draft:
    name = rng.choices(NAMES, WEIGHTS)[0]
    text = (SHIPPED / f"{name}.yaml").read_text(encoding="utf-8")
    if rng.random() < 0.65:
        tree = yaml_tree(text)
        if tree.get("variants") and rng.random() < 0.7:
            # One variant is as good as four, and four times as fast.
            kept = rng.choice(list(tree["variants"]))
            tree["variants"] = {kept: tree["variants"][kept]}
        mutation = "; ".join(mutate_tree(rng, tree) for _ in range(rng.choice((1, 1, 1, 2, 3))))
        data = yaml_text(tree).encode("utf-8", "surrogatepass")
    else:
        data, mutation = mutate_text(rng, text)
        if rng.random() < 0.2:
            data, more = mutate_text(rng, data.decode("utf-8", "replace"))
            mutation = f"{mutation}; {more}"
    return reading(f"{name}: {mutation}", data, run=rng.random() < 0.3)


def reading(mutation: str, data: bytes, run: bool, overrides: tuple[str, ...] = ()) -> Draft:
    """Return a case of one scenario file: check it, and if ``run`` also simulate 0.01 s over existing files."""
    arguments = [word for text in overrides for word in ("--set", text)]
    commands = [["check", "scenario.yaml", *arguments]]
    if run:
        short = [word for text in SHORT for word in ("--set", text)]
        commands.append(["run", "scenario.yaml", "--no-figures", "--quiet", "--out", "out", *arguments, *short])
    return Draft(mutation, {"scenario.yaml": data, **(OLD if run else {})}, commands, losses)


def losses() -> list[str]:
    """Return losses of every variant of scenario.yaml."""
    from dynsim.scenario import load_scenario, variant_names

    names: list[Any] = variant_names("scenario.yaml") or [None]
    loaded = [load_scenario("scenario.yaml", name) for name in names]
    tree = yaml_tree(Path("scenario.yaml").read_text(encoding="utf-8"))
    variants = tree.get("variants") or {}
    lost = []
    for name, scenario in zip(names, loaded, strict=True):
        lost += scenario_losses(merged(tree, variants.get(name) or {}), scenario)
    return lost
