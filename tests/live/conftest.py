"""Live drives in processes of their own."""

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
        drive = Teleop(tmp_path / f"drive_{len(started)}", *arguments)
        started.append(drive)
        return drive

    yield starts
    for drive in started:
        if drive.process.poll() is None:
            drive.process.kill()
            drive.process.wait()
        if drive.process.stdout is not None:
            drive.process.stdout.close()
