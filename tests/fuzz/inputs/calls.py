"""Calls of the Python interface: values of wrong types, and sequences of valid steps of a simulation."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from fuzz.case import Draft
from fuzz.inputs.simulation import FAMILIES, varied
from fuzz.mutations import yaml_text

VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 3, 2**70, 0.0, 0.5, -2.5, 1e300, math.nan, math.inf, 1j, "", "x", "joint_1",
    "z", "\x00", b"x",
    [], [0.0], [1, "x"], [[1, 2], [3]], (), {}, {"a": 1}, {1: 2}, {"joint_1": 0.5}, {"duration_s": "x"}, set(),
    object, object(),
    len, lambda: 1, lambda *_: None, range(3), Path("nowhere"), Path(), np.zeros(3), np.zeros((2, 2)),
    np.array([1, None]),
    np.array(["x"]), np.nan, np.float32(1), np.int64(2), slice(1), Ellipsis, NotImplemented, iter([1]), ValueError("x"),
)  # fmt: skip
STEPS = (
    "advance", "advance", "advance", "set_reference", "set_command", "set_supply", "set_brake", "set_wrench",
    "release", "set_mode", "snapshot", "restore", "linearize", "record", "advance back",
)  # fmt: skip


def draw(rng: Random, records: Path, kind: str) -> Draft:
    if kind == "steps":
        tree, mutation = varied(
            rng, rng.choice([*FAMILIES["arm"], "sampled_arm", "pressing", "soft_floor"]), rng.choice((0, 1))
        )
        seed = rng.randrange(10**9)
        return Draft(
            f"{mutation}; steps of seed {seed}",
            {"scenario.yaml": yaml_text(tree).encode()},
            [],
            partial(steps, seed),
            True,
        )
    names = [*_targets()]
    name = rng.choice(names)
    count = rng.choice((1, 1, 2, 3))
    picked = [rng.randrange(len(VALUES)) for _ in range(count)]
    keyword = rng.random() < 0.5
    return Draft(
        f"{name}({', '.join(repr(VALUES[k])[:40] for k in picked)})", {}, [], partial(call, name, picked, keyword)
    )


@cache
def _targets() -> dict[str, Callable[[], Any]]:
    """Return functions that make each public function and each method of three objects, by name."""
    import dynsim

    def simulation() -> Any:
        scenario = dynsim.load_scenario("single_pendulum", overrides={"duration_s": 0.02, "metrics.settle_s": 0})
        return dynsim.Simulation(scenario)

    def record() -> Any:
        return dynsim.Record([0.0, 0.1])

    def model() -> Any:
        return dynsim.build_model(dynsim.load_scenario("single_pendulum"))

    # Without functions that only call others, and without the display of a page.
    public = [
        name
        for name in dynsim.__all__
        if inspect.isroutine(getattr(dynsim, name)) or inspect.isclass(getattr(dynsim, name))
    ]
    made: dict[str, Callable[[], Any]] = {name: partial(getattr, dynsim, name) for name in public}
    for make in (simulation, record, model):
        for name, _ in inspect.getmembers(type(make()), inspect.isroutine):
            if not name.startswith("_"):
                made[f"{make.__name__}.{name}"] = partial(_method, make, name)
    return made


def _method(make: Callable[[], Any], name: str) -> Any:
    return getattr(make(), name)


def call(name: str, picked: list[int], keyword: bool) -> list[str]:
    """Call a function; an error must be a DynsimError, or a TypeError or ValueError that names an argument."""
    from dynsim.errors import DynsimError

    function = _targets()[name]()
    values = [VALUES[k] for k in picked]
    names = [*inspect.signature(function).parameters] if function.__module__ != "dynsim.errors" else []
    try:
        if keyword and names and "self" not in names[:1]:
            function(*values[:1], **dict(zip(names[1:], values[1:], strict=False)))
        else:
            function(*values)
    except DynsimError:
        raise
    except (TypeError, ValueError) as error:
        text = str(error)
        if not any(word in text for word in (*names, "argument", "arguments")):
            raise
        raise DynsimError(text) from None
    return []


def steps(seed: int) -> list[str]:
    """Take random valid steps of a simulation; a restored snapshot must continue bit by bit, the record be finite."""
    import dynsim
    from dynsim.errors import DynsimError

    rng = Random(seed)
    scenario = dynsim.load_scenario("scenario.yaml")
    simulation = dynsim.Simulation(scenario)
    lost: list[str] = []
    for _ in range(rng.choice((2, 4, 8))):
        try:
            lost += _step(rng, simulation, scenario.duration_s, rng.choice(STEPS))
        except DynsimError as refused:
            if not str(refused).strip():
                lost.append("an error without text")
    lost += _repeated(simulation, scenario.duration_s)
    record = simulation.record()
    return lost + [f"signal {name} is infinite" for name in record if np.isinf(record[name]).any()]


def _repeated(simulation: Any, duration: float) -> list[str]:
    """Advance to the end twice from a snapshot, and return a difference of the states."""
    snapshot = simulation.snapshot()
    states = []
    for _ in range(2):
        simulation.restore(snapshot)
        states.append(simulation.advance(duration))
    same = all(np.array_equal(a, b, equal_nan=True) for a, b in zip(*map(_arrays, states), strict=True))
    return [] if same else ["a restored snapshot continues differently"]


def _arrays(state: Any) -> Iterator[Any]:
    for name in ("time", "q", "v"):
        yield np.asarray(getattr(state, name), float)


def _step(rng: Random, simulation: Any, duration: float, name: str) -> list[str]:
    joints = [*simulation.model.joint_names, "x"]
    joint = rng.choice(joints)
    if name == "advance":
        simulation.advance(simulation.time + rng.choice((0.0, 1e-4, 0.3 * duration, duration)))
    elif name == "advance back":
        simulation.advance(simulation.time - rng.choice((1e-3, 1.0)))
    elif name == "set_reference":
        simulation.set_reference(joint, rng.uniform(-1, 1), rng.choice((0.0, 0.5)))
    elif name == "set_command":
        simulation.set_command(joint, rng.uniform(-12, 12))
    elif name == "set_supply":
        simulation.set_supply(rng.choice((0.0, 12.0, 24.0, -1.0)))
    elif name == "set_brake":
        simulation.set_brake(joint, rng.random() < 0.6)
    elif name == "set_wrench":
        simulation.set_wrench(
            rng.choice(("link_1", "link_2", "x")), [rng.uniform(-3, 3) for _ in range(3)], in_body=rng.random() < 0.5
        )
    elif name == "set_mode":
        simulation.set_mode(joint, rng.choice(("position", "velocity", "off", "x")))
    elif name == "release":
        simulation.release(joint)
    elif name == "linearize":
        simulation.linearize()
    elif name == "record":
        len(simulation.record())
    else:
        return _repeated(simulation, min(duration, simulation.time + 1e-3)) if simulation.time < duration else []
    return []
