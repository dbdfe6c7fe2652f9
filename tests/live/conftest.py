"""Drives in processes of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from support.teleop_clients import Teleop


@pytest.fixture
def teleop(tmp_path: Path) -> Iterator[Callable[..., Teleop]]:
    """Starts drives; none of them is left running."""
    pytest.importorskip("websockets", reason="no websockets here: pip install 'dynsim[live]'")
    started: list[Teleop] = []

    def starts(*arguments: str) -> Teleop:
        one = Teleop(tmp_path / f"drive_{len(started)}", *arguments)
        started.append(one)
        return one

    yield starts
    for one in started:
        if one.process.poll() is None:
            one.process.kill()
            one.process.wait()
        if one.process.stdout is not None:
            one.process.stdout.close()
