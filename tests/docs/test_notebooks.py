"""The notebooks of the documentation run from the first cell to the last; their own assertions hold."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import dynsim

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

NOTEBOOKS = sorted((Path(__file__).parents[2] / "docs" / "notebooks").glob("*.ipynb"))

pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("default")]  # those of the kernel's own libraries


def test_there_are_three() -> None:
    assert [notebook.stem for notebook in NOTEBOOKS] == ["pressing", "sweep", "urdf_arm"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = nbformat.read(path, as_version=4)
    # What is committed has no results: they are made where the site is built.
    assert not any(cell.outputs for cell in notebook.cells if cell.cell_type == "code")
    package = str(Path(dynsim.__file__).parents[1])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH")])))
    client = nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")
