"""Build hook of hatchling that writes the commit of a build into the package; records name that commit."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

NAME = "dynsim/commit.txt"


class CommitHook(BuildHookInterface[Any]):
    """Hook that writes ``dynsim/commit.txt`` into wheels and source distributions, not into the checkout."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the file to the build (see hatchling); an editable install reads the commit of the checkout."""
        root = Path(self.root)
        if version == "editable" or (root / NAME).is_file():
            return  # the source distribution that is built from already contains it
        asked = subprocess.run(["git", "rev-parse", "HEAD"], cwd=root, capture_output=True, text=True, check=False)
        if asked.returncode == 0 and (root / ".git").exists():
            self._folder = tempfile.TemporaryDirectory()
            file = Path(self._folder.name, "commit.txt")
            file.write_text(asked.stdout, encoding="ascii")
            build_data["force_include"][str(file)] = NAME

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the temporary file of the build."""
        if hasattr(self, "_folder"):
            self._folder.cleanup()
