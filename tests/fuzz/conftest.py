"""Valid records for the fuzzer, made once."""

from __future__ import annotations

from pathlib import Path

import pytest

from fuzz.inputs.record import make_records


@pytest.fixture(scope="session")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the valid records that the fuzzer damages."""
    folder = tmp_path_factory.mktemp("records")
    make_records(folder)
    return folder
