"""Records: what is written is what is read; a failed write leaves what was there."""

from pathlib import Path

import numpy as np
import pytest

from dynsim.errors import RecordError
from dynsim.files import check_writable
from dynsim.record import Record
from dynsim.results import save_run


@pytest.fixture
def record() -> Record:
    record = Record(np.linspace(0.0, 1.0, 5), provenance={"scenario": {"name": "x"}, "engine": "dynamics"})
    record.add("q", np.arange(10.0).reshape(5, 2), "rad", labels=("a", "b"), description="angles")
    record.add("force", np.arange(30.0).reshape(5, 2, 3), "N", labels=("c", "d"))
    record.summary = {"energy": 1.5}
    return record


def test_round_trip(record: Record, tmp_path: Path):
    record.complete = False
    again = Record.load(record.save(tmp_path / "a" / "record.h5"))
    assert np.array_equal(again.time, record.time)
    for name in record:
        assert np.array_equal(again[name], record[name])
    assert again.units == {"q": "rad", "force": "N"}
    assert again.labels["q"] == ("a", "b")
    assert (again.summary, again.provenance, again.complete) == (record.summary, record.provenance, False)


def test_wrong_length_and_labels_are_refused(record: Record):
    with pytest.raises(RecordError, match="samples"):
        record.add("x", np.zeros(4), "m")
    with pytest.raises(RecordError, match="labels"):
        record.add("x", np.zeros((5, 2)), "m", labels=("only",))


def test_unknown_signal_lists_what_there_is(record: Record):
    with pytest.raises(KeyError, match="q, force"):
        record["qq"]


def test_full_disk_leaves_the_old_record(record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = record.save(tmp_path / "record.h5")
    before = path.read_bytes()

    def fail(self: Path, data: bytes) -> None:
        self.write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(RecordError, match="No space left"):
        record.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_really_full_device_is_reported(record: Record, tmp_path: Path):
    # The temporary name is a link to a device on which every write fails for lack of space.
    (tmp_path / "record.h5.tmp").symlink_to("/dev/full")
    with pytest.raises(RecordError, match="cannot write"):
        record.save(tmp_path / "record.h5")
    assert not (tmp_path / "record.h5").exists()


def test_what_is_no_record_is_refused(tmp_path: Path):
    with pytest.raises(RecordError, match="no such record"):
        Record.load(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("hello")
    with pytest.raises(RecordError, match="not a readable HDF5"):
        Record.load(tmp_path / "text.h5")


def test_a_folder_that_cannot_be_written_is_found_without_making_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    check_writable(tmp_path / "new" / "deep")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordError, match="is a file, not a folder"):
        check_writable(tmp_path / "file" / "deep")
    # Root may write everywhere, so the answer is given here.
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(RecordError, match=f"no permission to write in {tmp_path}"):
        check_writable(tmp_path / "new")


def test_files_of_a_run_are_replaced_all_or_none(record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    save_run(record, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(before) == {"record.h5", "summary.json", "scenario.yaml"}
    record.provenance["scenario"] = {"name": "y"}
    record.summary = {"energy": 2.5}
    write_text = Path.write_text

    def fail(self: Path, text: str, **options: str) -> int:
        if self.name.startswith("scenario"):
            raise OSError(28, "No space left on device")
        return write_text(self, text, **options)

    monkeypatch.setattr(Path, "write_text", fail)
    with pytest.raises(RecordError, match="No space left"):
        save_run(record, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
