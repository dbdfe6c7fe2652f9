"""Records: valid files with damaged HDF5 structure or bytes."""

from __future__ import annotations

import hashlib
import io
import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import h5py
import numpy as np

from fuzz.case import Draft
from fuzz.inputs.faults import make_motion
from fuzz.inputs.sweep import make_sweep
from fuzz.mutations import TEXTS, mutate_blocks, mutate_bytes
from fuzz.readings import Unreadable, record_losses

FORMATS = ("csv", "joint-trajectory", "urdf-log")
# Size of the last line, with the digest [bytes].
SIGNATURE = 80


def make_records(folder: Path) -> None:
    """Make short, valid records, identical in every campaign on a machine because they contain no time; and a sweep."""
    from dynsim.engine import simulate
    from dynsim.scenario import load_scenario

    for name, scenario, variant in (("arm", "elbow_comparison", "no_elbow"), ("snake", "snake_positioning", "x")):
        options = {"duration_s": 0.05, "record.rate_hz": 200, "metrics.settle_s": 0}
        record = simulate(load_scenario(scenario, variant, options))
        record.provenance = {key: record.provenance[key] for key in ("scenario", "engine")}
        record.summary = {
            key: item for key, item in record.summary.items() if "wall" not in key and key != "real_time_factor"
        }
        record.add_axis("camera", [0.0, 0.02, 0.04])
        record.add("marker", np.ones((3, 1, 3)), "m", labels=("m",), axis="camera")
        record.add_event(0.01, "contact opens", "elbow", value=1.0)
        record.save(folder / f"{name}.h5")
    make_sweep(folder / "sweep")
    make_motion(folder)


def draw(rng: Random, records: Path, kind: str) -> Draft:
    if kind == "hdf5":
        return _damaged(rng, records)
    name = rng.choice(("arm", "arm", "snake"))
    sound = (records / f"{name}.h5").read_bytes()
    structural = rng.random() < 0.55
    if structural:
        image = io.BytesIO(sound)
        with h5py.File(image, "r+") as file:
            mutation = "; ".join(_changed(rng, file) for _ in range(rng.choice((1, 1, 1, 2))))
        data = image.getvalue()
        if rng.random() < 0.7:
            # Without the digest in its last line, as written by another program.
            data = re.sub(rb"\n[\w-]+:[0-9a-f]{64}\n\Z", b"", data)
    else:
        data, mutation = sound, ""
        for _ in range(rng.choice((1, 1, 1, 4, 20))):
            data, mutation = mutate_bytes(rng, data)
    files = {"record.h5": data, "out.txt": b"an older export"}
    command = rng.choice(
        (
            ["hw", "check", "record.h5", "--map", name],
            ["export", "record.h5", "--out", "out.txt", "--format", rng.choice(FORMATS)],
            [
                "export",
                "record.h5",
                "--out",
                "out.txt",
                "--format",
                rng.choice(FORMATS),
                "--rate",
                rng.choice(("50", "1e3", "0", "-1", "nan", "inf", "1e-9")),
            ],
        )
    )
    if rng.random() < 0.01:
        command = ["plot", "record.h5", "--out", "figures"]
    if structural:
        command.append("--trust")
    else:
        # Accidental damage: an accepted record must equal the saved one.
        files["sound.h5"] = sound
    return Draft(f"{name}: {mutation}", files, [command], losses)


def _damaged(rng: Random, records: Path) -> Draft:
    """Return a record with large damage and a correct digest, or none, so that HDF5 reads it."""
    name = rng.choice(("arm.h5", "snake.h5", "measured.h5"))
    data, mutation = mutate_blocks(rng, (records / name).read_bytes()[:-SIGNATURE])
    if signed := rng.random() < 0.7:
        data += b"\ndynsim-sha256:%s\n" % hashlib.sha256(data).hexdigest().encode()
    command = rng.choice(
        (
            ["view", "record.h5", "--no-open", "--out", "page.html"],
            ["export", "record.h5", "--out", "out.txt", "--format", rng.choice((*FORMATS, "mcap"))],
            ["hw", "check", "record.h5", "--map", "arm"],
        )
    )
    command += [] if signed else ["--trust"]
    return Draft(f"{name}: {mutation}{' signed' * signed}", {"record.h5": data}, [command])


def losses() -> list[str]:
    """Return silent losses of a damaged record; a deliberately changed record must only be readable to the end."""
    from dynsim.record import Record

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        record = Record.load("record.h5", trust=not Path("sound.h5").exists())
    read(record)
    if said or not Path("sound.h5").exists():
        raise Unreadable("it was said, or the record was changed on purpose")
    return record_losses(Record.load("sound.h5"), record)


def read(record: Any) -> None:
    """Read everything, as figures and exports do."""
    len(record), repr(record), record.units, record.labels, bool(record.complete)
    record.summary.get("variant"), record.summary.get("warnings"), record.provenance.get("scenario")
    json.dumps([record.summary, record.provenance], default=str)
    for event in record.events:
        f"{event.time:g} {event.kind} {event.name} {event.value} {event.description}"
    if record.scene is not None:
        (
            record.scene.to_json(),
            record.scene.hand,
            [record.scene.surface(point.surface) for point in record.scene.points],
        )
    for name in record:
        signal = record.signals[name]
        np.isfinite(signal.data).all(), signal.data[:1].sum(), f"{signal.unit} {signal.description}"
        if record[name].shape[:1] != record.times(name).shape:
            raise AssertionError(f"signal {name!r} has {record[name].shape} samples, not {record.times(name).shape}")
        if signal.labels and [name for name in signal.labels if not isinstance(name, str)]:
            raise AssertionError(f"signal {name!r} has labels that are not texts: {signal.labels}")
        for column, _ in enumerate(signal.labels):
            signal.data[:, column].sum()


def _changed(rng: Random, file: Any) -> str:
    """Make a change and return its description; after a first change HDF5 may refuse the second one."""
    try:
        return _mutate(rng, file)
    except (OSError, ValueError, RuntimeError) as error:
        return f"a change that HDF5 refuses ({error})"


def _mutate(rng: Random, file: h5py.File) -> str:
    """Damage one object of the file; return a description."""
    names: list[str] = []
    file.visit(names.append)
    path = rng.choice([*names, "time", "signals", "summary", "provenance", "scene", "events", "axes", "signals/q"])
    if path not in file:
        return f"{path} is gone already"
    ways: dict[str, Callable[[], Any]] = {
        "without": lambda: file.__delitem__(path),
        "as a group": lambda: _put(file, path, None),
        "as": lambda: _put(file, path, rng.choice(_DATA)()),
        "reshaped": lambda: _put(file, path, _reshaped(rng, file[path])),
        "attribute": lambda: _attribute(rng, file[path] if rng.random() < 0.8 else file),
        "moved": lambda: file.move(
            path,
            rng.choice(
                ("x", "signals/x", "signals/a/b", "time2", "signals/\x1b[31m", "signals/[red]", "signals/" + "x" * 300)
            ),
        ),
        "soft link": lambda: _put(file, path, h5py.SoftLink(rng.choice(("/nowhere", "/time", "/signals", path, "/")))),
        "external link": lambda: _put(
            file, path, h5py.ExternalLink(rng.choice(("/etc/passwd", "nowhere.h5", "record.h5", "/dev/zero")), "/time")
        ),
        "hard link": lambda: _put(
            file, path, file[rng.choice(("time", "signals", "/"))] if "time" in file and "signals" in file else None
        ),
        "text": lambda: _put(
            file,
            path,
            rng.choice(
                (
                    "",
                    "{",
                    "[]",
                    "null",
                    "1",
                    '"x"',
                    "{}",
                    "[[",
                    '{"a": NaN}',
                    "\u0000",
                    "[" * 5000,
                    "9" * 5000,
                    '{"variant": 1}',
                    '{"variant": "../../x"}',
                    '{"variant": "\\u001b[31m"}',
                    '{"contacts": 1}',
                    '{"warnings": 1}',
                    '{"bodies": []}',
                    '{"bodies": [{"name": "b", "parent": 5}]}',
                    '{"fixed": [{"kind": "box", "size": [1, 1]}]}',
                )
            ),
        ),
        "extra": lambda: _put(
            file,
            rng.choice(
                (
                    "extra",
                    "signals/extra",
                    "signals/" + rng.choice([t for t in TEXTS if t.strip("./ \x00") and "\x00" not in t]),
                )
            ),
            np.zeros(3),
        ),
        "nan": lambda: _spoil(rng, file[path]),
    }
    kind = rng.choice(list(ways))
    ways[kind]()
    return f"{path}: {kind}"


_DATA: tuple[Callable[[], Any], ...] = (
    lambda: 1.0, lambda: np.zeros(0), lambda: np.zeros((0, 3)), lambda: np.zeros((11, 0)), lambda: np.zeros(11),
    lambda: np.zeros((11, 10)), lambda: np.zeros((11, 10, 2)), lambda: np.zeros(11, dtype=complex),
    lambda: np.zeros(11, dtype="i1"), lambda: np.zeros(11, dtype=bool), lambda: np.array([b"x"] * 11), lambda: "text",
    lambda: b"\xff\xfe", lambda: h5py.Empty("f8"), lambda: np.zeros(11, dtype=[("a", "f8"), ("b", "i4")]),
    lambda: np.arange(11.0)[::-1], lambda: np.full(11, np.nan), lambda: np.full((11, 10), np.inf),
    lambda: np.full((11, 10), 1e300), lambda: np.zeros(11, "f2"),
    lambda: np.array(["ä", "b"], dtype=h5py.string_dtype()), lambda: np.zeros(100_000),
)  # fmt: skip


def _put(file: h5py.File, path: str, item: Any) -> None:
    attributes = dict(file[path].attrs) if path in file else {}
    if path in file:
        del file[path]
    if item is None:
        file.create_group(path)
    elif isinstance(item, str) and "\x00" in item:
        file[path] = np.void(item.encode())
    else:
        file[path] = item
        if isinstance(item, np.ndarray):
            for key, text in attributes.items():
                file[path].attrs[key] = text


def _reshaped(rng: Random, item: Any) -> Any:
    if not isinstance(item, h5py.Dataset) or item.dtype.kind == "O" or item.ndim == 0:
        return np.zeros(2)
    data = item[()]
    return rng.choice(
        (
            data[:-1],
            data[:1],
            data[:0],
            data.T.copy(),
            data.ravel(),
            data[..., None],
            data.astype("f4"),
            data.astype("S8"),
            data[::-1].copy(),
        )
    )


def _spoil(rng: Random, item: Any) -> None:
    if isinstance(item, h5py.Dataset) and item.dtype.kind == "f" and item.size:
        data = item[()]
        flat = data.reshape(-1)
        flat[rng.randrange(flat.size)] = rng.choice((np.nan, np.inf, -np.inf, 1e300, -1.0))
        item[...] = data


def _attribute(rng: Random, owner: Any) -> None:
    name = rng.choice([*owner.attrs, "unit", "labels", "format", "complete", "description"])
    if name in owner.attrs:
        del owner.attrs[name]
    new = rng.choice(
        (
            None,
            None,
            1,
            -1.5,
            "",
            "rad",
            "x",
            b"\xff",
            [],
            ["a"],
            ["a"] * 10,
            ["a"] * 11,
            [1, 2],
            [b"\xff"] * 10,
            np.nan,
            np.zeros((2, 2)),
            "\x1b[31m",
            "[red]",
            "x" * 3000,
            h5py.Empty("f4"),
        )
    )
    if new is not None:
        owner.attrs[name] = new
