"""The notebooks of the documentation are stored without results; the site runs them (test_site.py)."""

from __future__ import annotations

import json
from pathlib import Path

NOTEBOOKS = sorted((Path(__file__).parents[2] / "docs" / "notebooks").glob("*.ipynb"))


def test_notebooks_are_stored_without_results() -> None:
    assert [notebook.stem for notebook in NOTEBOOKS] == ["pressing", "sweep", "urdf_arm"]
    for notebook in NOTEBOOKS:
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)
