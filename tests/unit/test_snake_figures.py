"""Figures of a snake run: files are written and readable (what they look like is for eyes)."""

import numpy as np
import pytest
from PIL import Image

from dynsim.engine import simulate
from dynsim.figures import snake as figures
from dynsim.record import Record
from dynsim.scenario import load_scenario
from dynsim.studies.tanaka2019 import TABLE_III, table_iii


@pytest.fixture(scope="module")
def record():
    return simulate(load_scenario("snake_joint_limits", None, {"duration_s": 3.0, "record.rate_hz": 50}))


def test_draw_writes_every_figure_from_a_record_on_disk(record, tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "FRAMES", 4)
    written = figures.draw(Record.load(record.save(tmp_path / "record.h5")), tmp_path / "figures")
    names = ["postures.png", "overview.png", "tracking.png", "joints.png", "redundancy.png", "animation.gif"]
    assert [path.name for path in written] == names
    for path in written:
        with Image.open(path) as image:
            assert min(image.size) > 200
            assert len(np.unique(np.asarray(image.convert("L")))) > 10
    with Image.open(written[-1]) as animation:
        assert animation.n_frames == 4


def test_comparison(record, tmp_path):
    written = figures.draw_comparison({"a": record, "b": record}, tmp_path)
    assert [path.name for path in written] == ["comparison.png", "final_postures.png"]
    assert all(path.stat().st_size > 10_000 for path in written)


def test_table_iii_sets_measured_and_simulated_side_by_side(simulated, tmp_path):
    records = {moved: simulated("snake_positioning", moved) for moved in TABLE_III}
    rows = table_iii(records)
    assert len(rows) == 1 + 4 * 6
    assert rows[5] == ["y", "target", "0", "0.1", "0", "0", "0", "0"]
    assert float(rows[8][3]) == pytest.approx(0.1, abs=1e-6)
    written = figures.draw_comparison(records, tmp_path)
    assert {"table_iii.csv", "table_iii.png"} <= {path.name for path in written}
