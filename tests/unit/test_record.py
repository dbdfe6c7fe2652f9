"""Records: round trip through files, signals and events, writes that fail, incomplete groups of files, data frames."""

import sys
from pathlib import Path

import numpy as np
import pytest
from support.messages import mentions, raises

from dynsim.engine.recording import save_drive, save_run
from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.scenario import load_scenario
from dynsim.system.files import INCOMPLETE


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
    with raises(RecordError, "x", "4", "5"):
        record.add("x", np.zeros(4), "m")
    with raises(RecordError, "x", "2", "1"):
        record.add("x", np.zeros((5, 2)), "m", labels=("only",))


def test_signals_on_further_time_axes(record: Record):
    record.add_axis("camera", [0.05, 0.4, 0.9])
    record.add("marker", np.arange(6.0).reshape(3, 2), "m", labels=("x", "y"), axis="camera")
    assert record.times("marker").tolist() == [0.05, 0.4, 0.9]
    assert record.times("q") is record.time
    assert (len(record), record["marker"].shape) == (5, (3, 2))
    with raises(RecordError, "x", "5", "camera", "3"):
        record.add("x", np.zeros(5), "m", axis="camera")
    with raises(RecordError, "x", "kamera", "time, camera"):
        record.add("x", np.zeros(3), "m", axis="kamera")
    with raises(RecordError, "markr", "marker"):
        record.times("markr")
    with raises(RecordError, "camera"):
        record.add("camera", np.zeros(5), "m")


@pytest.mark.parametrize(
    ("name", "times", "names"),
    [
        ("time", [0.0], ("time",)),
        ("q", [0.0], ("q",)),
        ("a/b", [0.0], ("a/b",)),
        ("late", [0.0, -1.0], ("late", "0")),
        ("late", [0.0, np.nan], ("late", "1")),
        ("late", [[0.0]], ("late", "(1, 1)")),
    ],
)
def test_a_time_axis_that_is_none_is_refused(record: Record, name: str, times: list, names: tuple[str, ...]):
    with raises(RecordError, *names):
        record.add_axis(name, times)
    assert record.axes == {}


def test_events_are_in_the_order_of_their_times(record: Record):
    for time, name in ((0.5, "b"), (0.1, "a"), (0.5, "c")):
        record.add_event(time, "contact opens", name, value=np.float64(2.0))
    assert [(event.time, event.name, event.value) for event in record.events] == [
        (0.1, "a", 2.0),
        (0.5, "b", 2.0),
        (0.5, "c", 2.0),
    ]
    assert mentions(repr(record), "3")
    with raises(RecordError, "x", "nan s"):
        record.add_event(np.nan, "x")


def test_tables_take_one_time_axis_and_data_sets_all(record: Record):
    pytest.importorskip("pandas")
    pytest.importorskip("xarray")
    record.add_axis("camera", [0.05, 0.4])
    record.add("marker", np.arange(8.0).reshape(2, 1, 4), "1", labels=("m",), axis="camera")
    frame = record.to_dataframe()
    assert list(frame.columns[:2]) == ["q.a", "q.b"]
    assert not [name for name in frame.columns if name.startswith("marker")]
    frame = record.to_dataframe("camera")
    assert list(frame.columns) == ["marker.m.w", "marker.m.x", "marker.m.y", "marker.m.z"]
    assert (frame.index.name, frame.index.tolist()) == ("camera [s]", [0.05, 0.4])
    with raises(RecordError, "kamera", "time, camera"):
        record.to_dataframe("kamera")
    dataset = record.to_xarray()
    assert dataset["marker"].dims == ("camera", "marker_label", "axis_4")
    assert dataset["camera"].values.tolist() == [0.05, 0.4]
    assert dataset["q"].dims == ("time", "q_label")


def test_unknown_signal_lists_what_there_is(record: Record):
    with raises(KeyError, "qq", "'q'", "q, force") as error:
        record["qq"]
    assert isinstance(error.value, RecordError)


def test_full_disk_leaves_the_old_record(record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = record.save(tmp_path / "record.h5")
    before = path.read_bytes()

    def fail(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", fail)
    with raises(RecordError, "record.h5", "No space left on device"):
        record.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_no_record_is_refused(tmp_path: Path):
    with raises(RecordError, "none.h5"):
        Record.load(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("hello")
    with raises(RecordError, "text.h5", "HDF5"):
        Record.load(tmp_path / "text.h5")


def test_files_of_a_run_are_replaced_all_or_none(record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    save_run(record, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(before) == {"record.h5", "summary.json", "scenario.yaml"}
    record.provenance["scenario"] = {"name": "y"}
    record.summary = {"energy": 2.5}
    written: list[int] = []

    def fail_at_the_third(descriptor: int) -> None:
        written.append(descriptor)
        if len(written) == 3:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", fail_at_the_third)
    with raises(RecordError, "scenario.yaml", "No space left on device"):
        save_run(record, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_files_of_a_run_that_died_while_saving_are_not_taken_for_whole(record: Record, tmp_path: Path):
    save_run(record, tmp_path)
    (tmp_path / INCOMPLETE).touch()  # killed before it could write which files
    with raises(RecordError, "record.h5", INCOMPLETE):
        Record.load(tmp_path / "record.h5")
    with raises(RecordError, "scenario.yaml", INCOMPLETE):
        load_scenario(tmp_path / "scenario.yaml")
    save_run(record, tmp_path)
    assert Record.load(tmp_path / "record.h5").summary == record.summary


def test_thousands_of_labels(tmp_path: Path):
    labels = tuple(f"joint_{k} (ü)" for k in range(10_000))
    record = Record([0.0, 1.0])
    record.add("q", np.zeros((2, 10_000)), "rad", labels=labels)
    assert Record.load(record.save(tmp_path / "record.h5")).labels["q"] == labels


def test_what_could_not_be_read_again_is_not_saved(record: Record, tmp_path: Path):
    for data, names in (
        (["a"] * 5, ("x", "<U1")),
        (np.zeros(5, dtype=complex), ("x", "complex128")),
        (np.zeros((5, 1, 1, 1)), ("x", "4")),
        (0.0, ("x", "0")),
    ):
        with raises(RecordError, *names):
            record.add("x", data, "m", labels=("a",))
    for name in ("", ".", "a/b"):
        with raises(RecordError, f"'{name}'"):
            record.add(name, np.zeros(5), "m")
    with raises(RecordError, "1"):
        Record([0.0, 1.0, 0.5]).save(tmp_path / "record.h5")
    with raises(RecordError, "1"):
        Record([0.0, np.nan]).save(tmp_path / "record.h5")
    record.add("x", np.zeros((5, 1)), "m", labels=("a\0b",))
    with raises(RecordError, "x"):
        record.save(tmp_path / "record.h5")
    assert list(tmp_path.iterdir()) == []


def test_a_record_introduces_itself(record: Record):
    assert mentions(repr(record), "<Record x", "5", "1 s", "2", "(q, force)")
    assert list(record.keys()) == list(record) == ["q", "force"]
    assert set(dict(record)) == {"q", "force"}
    empty = Record([])
    empty.complete = False
    assert mentions(repr(empty), "<Record", "0", "incomplete")


def test_as_pandas_data_frame(record: Record):
    pytest.importorskip("pandas")
    record.add("state", [1, 1, 2, 2, 2], "1")
    frame = record.to_dataframe()
    vectors = [f"force.{label}.{axis}" for label in "cd" for axis in "xyz"]
    assert list(frame.columns) == ["q.a", "q.b", *vectors, "state"]
    assert np.array_equal(frame.index, record.time)
    assert np.array_equal(frame["q.b"], record["q"][:, 1])
    assert np.array_equal(frame["force.d.y"], record["force"][:, 1, 1])
    assert frame["state"].dtype == np.int64
    assert frame.attrs["units"]["force.c.x"] == "N"
    assert len(Record([0.0, 1.0]).to_dataframe()) == 2


def test_as_xarray_data_set(record: Record):
    pytest.importorskip("xarray")
    record.add("v", np.ones((5, 2)), "rad/s", labels=("a", "b"))
    dataset = record.to_xarray()
    # Same labels, same dimension: rates times angles is no outer product.
    assert (dataset.q * dataset.v).shape == (5, 2)
    assert dataset.force.dims == ("time", "force_label", "axis")
    assert float(dataset.force.sel(force_label="d", axis="z", time=0.25)) == record["force"][1, 1, 2]
    assert dataset.q.attrs == {"units": "rad", "long_name": "angles"}
    assert dataset.attrs["complete"] == 1


@pytest.mark.parametrize(("method", "package"), [("to_dataframe", "pandas"), ("to_xarray", "xarray")])
def test_a_missing_package_is_one_line_with_the_way_out(
    record: Record, monkeypatch: pytest.MonkeyPatch, method: str, package: str
):
    monkeypatch.setitem(sys.modules, package, None)
    with raises(RecordError, f"pip install {package}"):
        getattr(record, method)()


def test_a_drive_that_has_no_room_leaves_its_script(tmp_path: Path, simulated, monkeypatch: pytest.MonkeyPatch) -> None:
    record = simulated("single_pendulum", None)

    def full(*_: object) -> None:
        raise RecordError("record.h5: No space left on device")

    monkeypatch.setattr("dynsim.engine.recording.replace_together", full)
    with raises(RecordError, "record.h5", "No space left on device", "dynsim run", "scenario.yaml"):
        save_drive(record, tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["scenario.yaml"]
    assert load_scenario(tmp_path / "scenario.yaml").name == record.provenance["scenario"]["name"]
    monkeypatch.setattr("dynsim.engine.recording.write_text", full)
    with pytest.raises(RecordError, match=r"^record\.h5: No space left on device$"):
        save_drive(record, tmp_path)


def test_save_rejects_a_path_with_a_null_character(record: Record, tmp_path: Path):
    for path in ("a\0", "a\0/b.h5"):
        with raises(RecordError, "null"):
            record.save(str(tmp_path / path))
