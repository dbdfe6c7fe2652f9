"""Meshes of robots from URDF files. First state: none is read; what cannot be drawn is named in a note."""

from __future__ import annotations

from typing import Any

from dynsim.record import Record
from dynsim.view.blocks import Blocks


class Meshes:
    """Meshes of a page, each once."""

    def __init__(self, blocks: Blocks) -> None:
        self.blocks = blocks
        self.found: list[dict[str, Any]] = []
        self.missing: dict[str, None] = {}

    def of_robot(self, record: Record) -> None:
        """Look for what follows where the robot of this record came from."""

    def index(self, file: str) -> int | None:
        """Number of a mesh among those of the page; None where it cannot be read."""
        self.missing[file] = None
        return None

    def notes(self) -> list[str]:
        """What could not be drawn."""
        return [f"not found: {name}" for name in self.missing]
