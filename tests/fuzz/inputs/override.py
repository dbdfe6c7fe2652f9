"""Overrides: ``--set`` with valid and nonsense keys and values."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from random import Random

from fuzz.case import SHIPPED, Draft
from fuzz.inputs.scenario import reading
from fuzz.mutations import at, is_number, near, places, value, yaml_text
from fuzz.readings import merged, scenario_losses, set_dotted, yaml_tree

NAMES = ("elbow_comparison", "single_pendulum", "snake_positioning")
KEYS = (
    "", ".", "..", "a", "a.b", ".a", "a.", "plant.", "plant..type", "plant.chain.²", "plant.chain.-1",
    "plant.chain.99", "plant.chain.0", "plant.chain.0.mass_kg", "plant.chain.1e0", "plant.chain.٣", "plant.chain.0.0",
    "variants", "variants.x", "variants.two_elbows", "name", "variant", "description", "duration_s", "duration_s.x",
    "plant", "plant.type", "controller", "controller.type", "surfaces", "surfaces.floor", "surfaces.new.type",
    "contacts.points", "contacts.points.elbow_4.friction", "contacts.points.new.body", "integrator.rtol",
    "integrator.method", "record.rate_hz", "metrics.settle_s", "plant.link", "plant.link.mass_kg", "plant.link.motor",
    "plant.link.motor.type", "plant.initial_deg", "plant.initial_deg.0", "plant.initial_deg.9",
    "plant.initial_deg.10", "plant.hand", "plant.hand.body", "contacts.law", "<<", "*", "&a", "[0]", "plant[chain]",
    "\x1b[31m", "[red]", "-", "--set", "é", "plant.chain.0.motor", "x" * 300, "a." * 500 + "a",
)  # fmt: skip


@cache
def real_keys(name: str) -> tuple[str, ...]:
    tree = yaml_tree((SHIPPED / f"{name}.yaml").read_text(encoding="utf-8"))
    tree.pop("variants", None)
    return tuple(".".join(map(str, path)) for path in places(tree))


def path_of(key: str) -> tuple[str | int, ...]:
    return tuple(int(part) if part.isdecimal() else part for part in key.split("."))


def draw(rng: Random, records: Path) -> Draft:
    name = rng.choice(NAMES)
    tree = yaml_tree((SHIPPED / f"{name}.yaml").read_text(encoding="utf-8"))
    variants = tree.get("variants") or {}
    if variants:
        kept = rng.choice(list(variants))
        tree["variants"] = variants = {kept: variants[kept]}
    overrides = []
    if rng.random() < 0.3:
        # A key that dynsim probably accepts, so that losses can be detected.
        key = rng.choice([key for key in real_keys(name) if is_number(at(tree, path_of(key)))])
        overrides.append(f"{key}={near(rng, at(tree, path_of(key)))}")
    for _ in range(rng.choice((1, 1, 1, 2, 3)) if not overrides else 0):
        real = rng.choice(real_keys(name))
        key = rng.choice((real, real, real, rng.choice(KEYS), f"{real}.x", real[:-1], real.replace(".", "..")))
        try:
            old = at(tree, path_of(key))
        except (LookupError, TypeError, ValueError):
            old = None
        item = value(rng, old)
        # As a user types it: rarely quoted.
        text = item if isinstance(item, str) and rng.random() < 0.7 else yaml_text(item).strip()
        # No NUL: the system cannot pass it to a program.
        overrides.append(
            rng.choice((f"{key}={text}",) * 9 + (key, f"{key}=", f"={text}", f"{key}=={text}")).replace("\x00", "")
        )
    case = reading(
        f"{name}: --set {'; --set '.join(text[:80] for text in overrides)}",
        yaml_text(tree).encode(),
        rng.random() < 0.3,
        tuple(overrides),
    )
    case.losses = lambda: losses(overrides)
    return case


def losses(overrides: list[str]) -> list[str]:
    """Return values of the file and the overrides that the scenario lacks."""
    from dynsim.scenario import load_scenario, parse_override, variant_names

    name = next(iter(variant_names("scenario.yaml")), None)
    scenario = load_scenario("scenario.yaml", name, dict(map(parse_override, overrides)))
    tree = yaml_tree(Path("scenario.yaml").read_text(encoding="utf-8"))
    tree = merged(tree, (tree.get("variants") or {}).get(name) or {})
    for text in overrides:
        key, _, item = text.partition("=")
        set_dotted(tree, key.strip(), yaml_tree(item))
    return scenario_losses(tree, scenario)
