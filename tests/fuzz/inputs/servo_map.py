"""Servo maps: shipped files, damaged, checked against a valid record."""

from __future__ import annotations

from pathlib import Path
from random import Random

from fuzz.case import SHIPPED, Draft
from fuzz.mutations import mutate_text, mutate_tree, yaml_text
from fuzz.readings import servo_map_losses, yaml_tree


def draw(rng: Random, records: Path) -> Draft:
    name = rng.choice(("arm", "arm", "snake"))
    text = (SHIPPED / "hardware" / f"{name}.yaml").read_text(encoding="utf-8")
    if rng.random() < 0.65:
        tree = yaml_tree(text)
        mutation = "; ".join(mutate_tree(rng, tree) for _ in range(rng.choice((1, 1, 1, 2, 3))))
        data = yaml_text(tree).encode("utf-8", "surrogatepass")
    else:
        data, mutation = mutate_text(rng, text)
    command = ["hw", "check", "record.h5", "--map", "map.yaml"]
    if rng.random() < 0.15:
        option, texts = rng.choice(
            (
                ("--rate", ("0", "-1", "nan", "inf", "1e9", "1e-300")),
                ("--speed", ("0", "-1", "nan", "inf", "1e300", "1e-300")),
            )
        )
        command += [option, rng.choice(texts)]
        mutation += f" {' '.join(command[-2:])}"
    files = {"map.yaml": data, "record.h5": (records / f"{name}.h5").read_bytes()}
    return Draft(f"{name}: {mutation}", files, [command], losses)


def losses() -> list[str]:
    """Return losses of the map."""
    from dynsim.hardware.servo_map import load_servo_map

    servo_map = load_servo_map("map.yaml")
    return servo_map_losses(yaml_tree(Path("map.yaml").read_text(encoding="utf-8")), servo_map)
