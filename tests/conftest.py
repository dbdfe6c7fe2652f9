"""Fixtures shared by all folders."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from ruamel.yaml import YAML

from dynsim.control import task_space
from dynsim.plants import snake
from dynsim.record import Record
from dynsim.simulate.kinematic import simulate_kinematic


def _merge(base: Any, change: Any) -> Any:
    if not (isinstance(base, dict) and isinstance(change, dict)):
        return change
    return base | {key: _merge(base.get(key), value) for key, value in change.items()}


@cache
def _simulated(name: str, variant: str) -> Record:
    data = YAML(typ="safe").load(Path(__file__).parent.parent / "scenarios" / f"{name}.yaml")
    variants = data.pop("variants", {})
    data = _merge(data, variants[variant] if variant else {})
    return simulate_kinematic(
        SimpleNamespace(
            name=name,
            variant=variant,
            duration_s=data["duration_s"],
            plant=snake.Config(**data["plant"]),
            controller=task_space.Config(**data["controller"]),
            record=SimpleNamespace(**data["record"]),
            resolved=data,
        )
    )


@pytest.fixture(scope="session")
def snake_run() -> Callable[[str, str], Record]:
    """Record of a shipped snake scenario and variant, simulated once per session."""
    return _simulated
