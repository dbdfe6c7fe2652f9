"""Damaged and malicious record files: each is read as written or refused in one line; none crashes dynsim.

The HDF5 library itself crashes, or never returns, on one of sixty damaged files, so most of these tests
read files in child processes.
"""

import itertools
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support.messages import raises

from dynsim.errors import RecordError
from dynsim.record import Record, isolated, reader
from dynsim.record.scene import Body, Joint, Point, Scene, SceneSurface, Shape


def sample() -> Record:
    record = Record(np.linspace(0.0, 1.0, 5), provenance={"scenario": {"name": "x"}, "engine": "dynamics"})
    record.add("q", np.arange(10.0).reshape(5, 2), "rad", labels=("a", "b"), description="angles")
    record.add("force", np.arange(30.0).reshape(5, 2, 3), "N", labels=("c", "d"))
    record.add("closed", [True, False, True, True, False], "1")
    record.summary = {"energy": 1.5}
    return record


SCENE = Scene(
    bodies=(
        Body("a", -1, Joint("j", "revolute", (0.0, 0.0, 1.0), (0.0, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0), "q", ("a",))),
        Body(
            "b",
            0,
            Joint("k", "prismatic", (1.0, 0.0, 0.0), (0.0, 0.3, 0.0), (0.6, 0.8, 0.0, 0.0), "q", ("b",), upper=0.5),
            (Shape("box", (0.1, 0.2, 0.3), colour=(1.0, 0.5, 0.0, 1.0)), Shape("mesh", (1.0, 1.0, 1.0), file="b.stl")),
        ),
    ),
    surfaces=(SceneSurface.of_quadric("floor", np.zeros((3, 3)), [0.0, 0.0, 2.0], 1.0),),
    points=(Point("hand", "hand", 1, (0.0, 0.0, 0.5)), Point("elbow", "contact", 0, (0.0, 0.0, 0.1), "floor")),
    fixed=(Shape("cylinder", (0.1, 0.4), (0.0, 0.0, -0.2)),),
)


def telling() -> Record:
    """The sample with all that a record can hold beside signals."""
    record = sample()
    record.add_axis("camera", [0.1, 0.2])
    record.add("marker", np.ones((2, 1, 3)), "m", labels=("m",), axis="camera")
    record.add_event(0.7, "contact opens", "elbow", value=0.0, description="of its own")
    record.add_event(0.2, "contact closes", "elbow")
    record.scene = SCENE
    return record


def same(record: Record, other: Record) -> bool:
    """Whether two records hold the same, descriptions aside."""
    return (
        np.array_equal(record.time, other.time)
        and sorted(record) == sorted(other)
        and all(np.array_equal(record[name], other[name]) for name in record)
        and record.axes.keys() == other.axes.keys()
        and all(np.array_equal(record.times(name), other.times(name)) for name in record)
        and (record.events, record.scene) == (other.events, other.scene)
        and (record.units, record.labels) == (other.units, other.labels)
        and (record.summary, record.provenance, record.complete) == (other.summary, other.provenance, other.complete)
    )


def test_axes_events_and_scene_come_back(tmp_path: Path):
    again = Record.load(telling().save(tmp_path / "record.h5"))
    assert same(again, telling())
    assert again.times("marker").tolist() == [0.1, 0.2]
    assert [(event.time, event.kind, event.value) for event in again.events] == [
        (0.2, "contact closes", None),
        (0.7, "contact opens", 0.0),
    ]


def test_large_signals_are_packed_and_unpacked(tmp_path: Path):
    record = Record(np.arange(300_000.0))
    record.add("x", np.random.default_rng(1).standard_normal((300_000, 3)), "m", labels=("a", "b", "c"))
    record.add("zero", np.zeros((300_000, 2, 3), dtype=np.float32), "m", labels=("a", "b"))
    again = Record.load(record.save(tmp_path / "record.h5"))
    assert h5py.File(tmp_path / "record.h5")["signals/zero"].compression == "gzip"
    assert same(again, record)
    assert again["zero"].dtype == np.float32


def test_one_changed_byte_is_found(tmp_path: Path):
    path = sample().save(tmp_path / "record.h5")
    whole = path.read_bytes()
    offset = whole.index(np.array([7.0, 8.0]).tobytes())
    path.write_bytes(whole[:offset] + b"\x01" + whole[offset + 1 :])
    with raises(RecordError, "record.h5", "--trust"):
        Record.load(path)
    offset = whole.index(b"dynsim-record")
    path.write_bytes(whole[:offset] + b"D" + whole[offset + 1 :])
    with raises(RecordError, "record.h5", "SHA-256"):
        Record.load(path)


def test_a_file_without_digest_is_read_where_it_is_trusted(tmp_path: Path):
    path = sample().save(tmp_path / "record.h5")
    path.write_bytes(path.read_bytes()[:-80])
    with raises(RecordError, "record.h5", "SHA-256", "trust=True"):
        Record.load(path)
    assert same(Record.load(path, trust=True), sample())


def test_a_file_changed_by_another_program_is_read_where_it_is_trusted(tmp_path: Path):
    path = sample().save(tmp_path / "record.h5")
    with h5py.File(path, "r+") as file:
        file["signals/q"][0, 0] = 42.0
    with raises(RecordError, "record.h5", "--trust"):
        Record.load(path)
    assert Record.load(path, trust=True)["q"][0, 0] == 42.0


def test_another_format_is_named(tmp_path: Path):
    path = sample().save(tmp_path / "record.h5")
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "dynsim-record-1"
    with raises(RecordError, "dynsim-record-1", "dynsim-record-2"):
        Record.load(path, trust=True)


Change = Callable[[h5py.File, Path], Any]


def replaced(name: str, value: Any, **attributes: Any) -> Change:
    """Another data set under a name, with the attributes of a signal or others."""

    def change(file: h5py.File, _: Path) -> None:
        before = dict(file[name].attrs) if name in file and name.startswith("signals/") else {}
        if name in file:
            del file[name]
        file[name] = value
        file[name].attrs.update(before | attributes)

    return change


def attribute(owner: str, name: str, value: Any) -> Change:
    def change(file: h5py.File, _: Path) -> None:
        if value is None:
            del file[owner].attrs[name]
        else:
            file[owner].attrs[name] = value

    return change


def removed(name: str) -> Change:
    return lambda file, _: file.__delitem__(name)


def external(file: h5py.File, folder: Path) -> None:
    with h5py.File(folder / "other.h5", "w") as other:
        other["q"] = np.zeros((5, 2))
    del file["signals/q"]
    file["signals/q"] = h5py.ExternalLink(str(folder / "other.h5"), "/q")


def soft(file: h5py.File, _: Path) -> None:
    del file["signals/q"]
    file["signals/q"] = h5py.SoftLink("/signals/force")


def soft_group(file: h5py.File, _: Path) -> None:
    del file["signals"]
    file["signals"] = h5py.SoftLink("/")


def circle(file: h5py.File, _: Path) -> None:
    file["signals/again"] = file["signals"]


def nested(file: h5py.File, _: Path) -> None:
    del file["signals/q"]
    file["signals/q/nested"] = 1.0


def raw_file(file: h5py.File, folder: Path) -> None:
    (folder / "secret").write_bytes(b"8 bytes!" * 5)
    file.create_dataset("signals/s", (5,), "f8", external=[(str(folder / "secret"), 0, 40)])


def virtual(file: h5py.File, folder: Path) -> None:
    layout = h5py.VirtualLayout((5,), "f8")
    layout[:] = h5py.VirtualSource(str(folder / "other.h5"), "x", (5,))
    file.create_virtual_dataset("signals/s", layout)


def bomb(file: h5py.File, _: Path) -> None:
    file.create_dataset("signals/s", (1 << 40, 5), "f8", chunks=(1 << 17, 5), compression="gzip")


def no_gzip(file: h5py.File, _: Path) -> None:
    dataset = file.create_dataset("signals/s", (5,), "f8", chunks=(5,), compression="gzip")
    dataset.id.write_direct_chunk((0,), b"this is no gzip")


def huge_contiguous(file: h5py.File, _: Path) -> None:
    file.create_dataset("time2", (1 << 45,), "f8")
    del file["time"]
    file["time"] = file["time2"]


def type_as_signal(file: h5py.File, _: Path) -> None:
    file["signals/s"] = np.dtype("f8")


def many_labels(file: h5py.File, _: Path) -> None:
    del file["signals/q"].attrs["labels"]
    file["labels/q"] = np.arange(2)


FOREIGN: list[tuple[Change, str]] = [
    (attribute("/", "format", "dynsim-record-9"), "dynsim-record-9 dynsim-record-2"),
    (attribute("/", "format", np.arange(3)), "HDF5 dynsim-record-2"),
    (attribute("/", "complete", None), "complete"),
    (attribute("/", "complete", "yes"), "complete"),
    (removed("time"), "time"),
    (removed("summary"), "summary"),
    (replaced("time", "soon"), "time object"),
    (replaced("time", 1.0), "time ()"),
    (replaced("time", np.zeros((5, 1))), "time (5, 1)"),
    (replaced("time", [0.0, 0.25, np.nan, 0.75, 1.0]), "time 2"),
    (replaced("time", [0.0, 0.25, np.inf, 0.75, 1.0]), "time 2"),
    (replaced("time", [0.0, 0.25, 0.2, 0.75, 1.0]), "time 1"),
    (replaced("time", np.arange(4.0)), "closed 5 4"),
    (replaced("time", h5py.Empty("f8")), "time"),
    (replaced("summary", 3.0), "summary"),
    (replaced("summary", ["{}"]), "summary"),
    (replaced("summary", "{"), "summary JSON"),
    (replaced("summary", "[1]"), "summary list"),
    (replaced("summary", "[" * 100_000), "summary JSON"),
    (replaced("summary", "1" * 5000), "summary JSON"),
    (replaced("provenance", "null"), "provenance"),
    (replaced("provenance", b"\xff\xfe"), ""),
    (replaced("signals", 1.0), "signals"),
    (replaced("signals/q", "text"), "q object"),
    (replaced("signals/q", np.zeros((5, 2), dtype=complex)), "q complex128"),
    (replaced("signals/q", np.zeros((5, 2), dtype=[("x", "f8")])), "q <f8"),
    (replaced("signals/q", np.zeros((4, 2))), "q 4 5"),
    (replaced("signals/q", np.zeros((5, 3))), "q 3 2"),
    (replaced("signals/q", np.zeros((5, 2, 1, 1))), "q 4"),
    (replaced("signals/q", np.zeros((5, 2)), labels=[1.0, 2.0]), "q labels"),
    (replaced("signals/q", np.zeros((5, 2)), labels=[["a", "b"]]), "q labels"),
    (replaced("signals/q", np.zeros((5, 2)), unit=3), "q unit"),
    (nested, "q"),
    (attribute("signals/q", "unit", None), "q unit"),
    (attribute("signals/q", "labels", None), "q labels"),
    (attribute("signals/q", "labels", h5py.Empty("f8")), "q labels"),
    (attribute("signals/q", "description", [1, 2]), "q description"),
    (external, "q"),
    (soft, "q"),
    (soft_group, "signals"),
    (circle, "again"),
    (raw_file, "s"),
    (virtual, "s"),
    (bomb, "s 43980465111040 900000000"),
    (no_gzip, "HDF5"),
    (huge_contiguous, "time 281474976710656"),
    (type_as_signal, "s"),
    (many_labels, "q labels"),
]


TOLD: list[tuple[Change, str]] = [
    (replaced("axes", 1.0), "axes"),
    (replaced("axes/camera", [0.2, 0.1]), "camera 0"),
    (replaced("axes/camera", [0.1, 0.2, 0.3]), "marker 2 camera 3"),
    (replaced("axes/time", [0.1]), "time"),
    (removed("axes/camera"), "marker camera time"),
    (attribute("signals/marker", "axis", "moon"), "marker moon time camera"),
    (attribute("signals/marker", "axis", 3), "marker axis"),
    (replaced("events", 1.0), "events"),
    (removed("events/kind"), "kind events"),
    (replaced("events/time", [0.1]), "kind events 2 1"),
    (replaced("events/time", [0.1, np.nan]), "time events"),
    (replaced("events/name", [1.0, 2.0]), "events name"),
    (replaced("events/value", ["x", "y"]), "value events object"),
    (replaced("scene", 1.0), "scene"),
    (replaced("scene", "{"), "scene JSON"),
    (replaced("scene", "[]"), "scene"),
    (replaced("scene", "[" * 100_000), "scene JSON"),
    (replaced("scene", '{"points": [{"name": "p", "role": "hand", "body": 0, "position": [0, 0, 0]}]}'), "p 0"),
    (
        replaced("scene", '{"points": [{"name": "p", "role": "x", "body": -1, "position": [0, 0, 0]}]}'),
        "scene points.0.role",
    ),
    (
        replaced("scene", '{"points": [{"name": "p", "role": "hand", "body": -1, "position": [0, 1]}]}'),
        "scene points.0.position.2",
    ),
    (replaced("scene", '{"fixed": [{"kind": "box", "size": [1, 2]}]}'), "box 3 2"),
    (replaced("scene", '{"fixed": [{"kind": "sphere", "size": [NaN]}]}'), "scene fixed.0.size.0"),
    (replaced("scene", '{"fixed": [{"kind": "sphere", "size": [1e999]}]}'), "scene fixed.0.size.0"),
]


@pytest.mark.parametrize(("change", "names"), TOLD, ids=itertools.count())
def test_axes_events_and_scenes_that_are_none_are_refused(tmp_path: Path, change: Change, names: str):
    path = telling().save(tmp_path / "record.h5")
    with h5py.File(path, "r+") as file:
        change(file, tmp_path)
    with raises(RecordError, *names.split()) as error:
        reader.decode(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def foreign(change: Change, folder: Path) -> Path:
    """A record that somebody has changed."""
    path = sample().save(folder / "foreign.h5")
    with h5py.File(path, "r+") as file:
        change(file, folder)
    return path


@pytest.mark.parametrize(("change", "names"), FOREIGN, ids=itertools.count())
def test_a_file_that_is_no_record_is_refused_with_the_reason(tmp_path: Path, change: Change, names: str):
    path = foreign(change, tmp_path)
    with raises(RecordError, *names.split()) as error:
        reader.decode(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_what_is_no_file_is_refused(tmp_path: Path):
    for path in (tmp_path, Path("/dev/zero")):
        with raises(RecordError, str(path)):
            Record.load(path)
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        with raises(RecordError, "pipe"):
            Record.load(tmp_path / "pipe")
    for path in (tmp_path / "none.h5", tmp_path / "none" / "none.h5"):
        with raises(RecordError, str(path)):
            Record.load(path)
    with raises(RecordError, "x" * 300):
        Record.load(tmp_path / ("x" * 300))
    for content in (b"", b"hello", b"\x89HDF\r\n\x1a\n"):
        (tmp_path / "text.h5").write_bytes(content)
        with raises(RecordError, "text.h5", "HDF5"):
            Record.load(tmp_path / "text.h5", trust=True)


# -- damage -----------------------------------------------------------------------------------------------------------


def flipped(whole: bytes, seed: int) -> bytes:
    """With one to many bytes changed."""
    dice = random.Random(seed)
    data = bytearray(whole)
    places = [k for k, value in enumerate(data) if value] if dice.random() < 0.7 else range(len(data))
    for _ in range(dice.choice([1, 1, 1, 2, 4, 8, 32])):
        data[dice.choice(places)] ^= dice.choice([1 << dice.randrange(8), 255])
    return bytes(data)


def mangled(whole: bytes, seed: int) -> bytes:
    """With the end cut off, something appended, a block zeroed or copied to elsewhere; all without the last line."""
    dice = random.Random(seed)
    data = bytearray(whole[:-80])
    length = dice.randrange(1, 64)
    to, source = dice.randrange(len(data) - length), dice.randrange(len(data) - length)
    match seed % 4:
        case 0:
            del data[to:]
        case 1:
            data += dice.randbytes(length)
        case 2:
            data[to : to + length] = bytes(length)
        case _:
            data[to : to + length] = data[source : source + length]
    return bytes(data)


def load_all(folder: Path, contents: list[bytes], written: str = "telling") -> list[str]:
    """Load files in a child; gives "same" (as ``written()``), "refused" or what else came of it, for each."""
    for number, content in enumerate(contents):
        (folder / f"{number}.h5").write_bytes(content)
    code = (
        "import sys; from dynsim.record import Record; from dynsim.errors import RecordError\n"
        f"sys.path[:0] = sys.argv[2:]; from test_record_file import same, {written}\n"
        "for number in range(int(sys.argv[1])):\n"
        f"    try: print('same' if same(Record.load(f'{{number}}.h5'), {written}()) else 'other', flush=True)\n"
        "    except RecordError as error:\n"
        "        print('refused' if str(error).startswith(f'{number}.h5: ') else repr(error), flush=True)\n"
        "    except BaseException as error: print(repr(error), flush=True)\n"
    )
    folders = Path(__file__).parents[:2]
    arguments = [sys.executable, "-c", code, str(len(contents)), *map(str, folders)]
    child = subprocess.run(arguments, cwd=folder, capture_output=True, text=True, check=False)
    assert child.returncode == 0, child.stderr
    return child.stdout.splitlines()


def test_damage_is_found_or_does_no_harm(tmp_path: Path):
    whole = bytes(telling().to_hdf5())
    contents = [flipped(whole[:-80], seed) + whole[-80:] for seed in range(400)]
    contents += [whole[:-80] + flipped(whole[-80:], seed) for seed in range(40)]
    contents += [mangled(whole, seed) for seed in range(80)]
    assert load_all(tmp_path, contents) == ["refused"] * len(contents)


# -- isolation --------------------------------------------------------------------------------------------------------

ENDLESS = Path(__file__).parents[1] / "fuzz" / "inputs" / "endless.h5"
"""A small record with a correct digest, on which the HDF5 library loops endlessly."""


def of_another_process(path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    telling().save(path)
    monkeypatch.setattr(reader, "_written", set())
    return path


def test_a_file_of_another_process_is_read_in_a_child_and_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = telling().save(tmp_path / "record.h5")
    with monkeypatch.context() as context:
        context.setattr(isolated, "read", None)
        here = Record.load(path)
    monkeypatch.setattr(reader, "_written", set())
    monkeypatch.setattr(reader, "decode", None)
    there = Record.load(path)
    assert same(here, there)
    assert there.signals["q"].data.flags.writeable


@pytest.mark.long
def test_an_endless_file_ends_with_one_error(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(isolated, "TIME_S", 2)
    with raises(RecordError, "endless.h5", "2 s", "processor time"):
        Record.load(ENDLESS)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_reading_ends_at_a_signal(number: signal.Signals, tmp_path: Path):
    """Also the child ends, which reads the endless file."""
    command = [sys.executable, "-P", "-m", "dynsim", "export", str(ENDLESS), "--format", "csv", "--out", "x.csv"]
    process = subprocess.Popen(
        command, cwd=tmp_path, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),  # in the background SIGINT is ignored
    )  # fmt: skip

    def children() -> list[int]:
        return [
            int(file.parent.name)
            for file in Path("/proc").glob("[0-9]*/stat")
            if f" {process.pid} " in file.read_text().rpartition(")")[2][:20]
        ]

    while not (readers := children()):
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, "Traceback" in errors) == (128 + number, False), errors
    assert not any(Path(f"/proc/{reader}").exists() for reader in readers)


@pytest.mark.parametrize(
    ("body", "names"),
    [
        ("os.kill(os.getpid(), signal.SIGSEGV)", "HDF5 SIGSEGV"),
        ("sys.stdout.buffer.write(b'half'); sys.exit(3)", "code 3"),
        ("bytearray(isolated.MEMORY)", "memory"),
    ],
)
def test_a_reader_that_dies_is_one_error(body: str, names: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = of_another_process(tmp_path / "record.h5", monkeypatch)
    served = "isolated.serve("
    assert served in isolated.START
    program = isolated.START.replace(served, f"import os; decode = lambda path: {body}\n{served}")
    monkeypatch.setattr(isolated, "START", program)
    with raises(RecordError, "record.h5", *names.split()):
        Record.load(path)


def test_a_file_that_expands_too_much_is_refused(tmp_path: Path):
    """A data set of zeros, 1 GB in 1 MB, from a stranger who wrote the right digest."""
    path = tmp_path / "zeros.h5"
    with h5py.File(telling().save(path), "r+") as file:
        del file["signals/force"]
        data = file.create_dataset("signals/force", (5, 4, 6_000_000), "f8", compression="gzip", fillvalue=1.0)
        data.attrs.update({"unit": "N", "labels": ["c"], "description": ""})
        data[0, 0, 0] = 2.0
    with raises(RecordError, "zeros.h5", "force", "960000000"):
        Record.load(path, trust=True)


@pytest.mark.long
def test_trusted_damage_ends_in_one_error_or_does_no_harm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Without the protection of the digest each file is read, refused, or ends its own reader."""
    monkeypatch.setattr(isolated, "TIME_S", 2)
    whole = bytes(telling().to_hdf5())
    refused = 0
    for seed in range(12):
        path = tmp_path / "record.h5"
        path.write_bytes(flipped(whole, seed) if seed % 2 else mangled(whole, seed))
        try:
            Record.load(path, trust=True)
        except RecordError as error:
            refused += str(error).startswith(f"{path}: ") and "\n" not in str(error)
        else:
            refused += 1
    assert refused == 12
