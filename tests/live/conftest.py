"""Live drives in processes of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from support.teleop_clients import Teleop


@pytest.fixture
def teleop(tmp_path: Path) -> Iterator[Callable[..., Teleop]]:
    """Starts drives, or other commands with a live page; none of them is left running."""
    pytest.importorskip("websockets", reason="no websockets here: pip install 'dynsim[live]'")
    started: list[Teleop] = []

    def starts(*arguments: str, **options: Any) -> Teleop:
        started.append(Teleop(tmp_path / f"drive_{len(started)}", *arguments, **options))
        return started[-1]

    yield starts
    for command in started:
        if command.process.poll() is None:
            command.process.kill()
            command.process.wait()
        if command.process.stdout is not None:
            command.process.stdout.close()
