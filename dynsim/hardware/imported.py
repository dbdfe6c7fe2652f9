"""Import of recorded motions: positions of a CSV file, an MCAP file or a record become a smooth motion with rates.

A cubic smoothing spline through the samples (t_k, q_k) of each joint minimises

    Σ_k (q_k − q(t_k))² + λ ∫ q''² dt,    λ = 1/(h ω_c⁴)

with the median sampling interval h. For uniform samples it is a filter without phase lag, whose gain 1/(1 + (ω/ω_c)⁴)
is one half at the bandwidth f_c = ω_c/2π. Position, rate and acceleration are continuous.
"""

from __future__ import annotations

import csv
import importlib
import math
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dynsim.config.problems import suggest
from dynsim.errors import RecordError, brief, first_few
from dynsim.hardware.bus.control_table import RAD_PER_TICK
from dynsim.hardware.servo_map import MappedServo, ServoMap
from dynsim.record import TIME, Record
from dynsim.record.csv_rows import NUMBER, SIZE_LIMIT
from dynsim.system.inputs import check_file, read_text

Array = NDArray[np.float64]

BANDWIDTH = 5.0
"""Largest default bandwidth [Hz]; motions that people demonstrate are slower."""
BANDWIDTH_SHARE = 6.0
"""The default bandwidth is at most this fraction of the sampling rate."""
DEVIATION = 0.05
"""Largest accepted difference between the smooth motion and a sample [rad]."""
SPIKE, SPIKE_SCALE, SPIKE_WINDOW = 0.03, 6.0, 15
"""An outlier differs from its neighbours by more than 0.03 rad and six deviations within a window of 15 samples."""
OUTLIER_SHARE = 0.05
"""Largest accepted fraction of outliers of a joint."""
LONG_STEP = 2.5
"""A step longer than this multiple of the median step is a gap."""
LOWEST_RATE, HIGHEST_RATE = 5.0, 5000.0
"""Range of plausible sampling rates [Hz]."""
FEWEST = 8
"""Smallest number of samples of a joint."""
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
TIME_NAMES = ("time", "t", "timestamp", "__time")
UNITS = {"rad": "rad", "deg": "deg", "°": "deg", "tick": "tick", "ticks": "tick"}
JOINT_STATE = "sensor_msgs/msg/JointState"
_COLUMN = re.compile(r"(.*?)\s*(?:[\[(]([^\])]*)[\])])?")
_TIME_COLUMN = re.compile(rf"({'|'.join(TIME_NAMES)})(?:_(s|ms|us|ns))?", re.IGNORECASE)


@dataclass
class RecordedSamples:
    """Recorded positions of one joint.

    Attributes
    ----------
    unit : str
        "rad", "deg", "tick", or empty if the file does not contain the unit.
    time, value : list of float
        Times [s], from any origin, and positions.
    number : list of int
        Line of the file, number of the message, or index of the sample.
    """

    unit: str
    time: list[float] = field(default_factory=list)
    value: list[float] = field(default_factory=list)
    number: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class Recording:
    """Recorded positions of all joints in a file; ``at`` is the text between the file and the number of a sample."""

    path: Path
    at: str
    joints: dict[str, RecordedSamples]

    def location(self, number: int) -> str:
        return f"{self.path}{self.at}{number}"


@dataclass(frozen=True)
class SmoothedJoint:
    """Smooth motion of one joint, and its differences from the samples.

    Attributes
    ----------
    joint : str
    spline : scipy.interpolate.BSpline
        Position over time [rad].
    start, end, step : float
        Times of the first and last sample, and median sampling interval [s].
    bandwidth : float
        Frequency at which the amplitude is halved [Hz].
    rms, max : float
        Rms and maximum difference from the samples [rad].
    outliers, merged, bridged : list of str
        Outliers, repeated samples, and gaps, with the locations in the file.
    """

    joint: str
    spline: Any
    start: float
    end: float
    step: float
    bandwidth: float
    rms: float
    max: float
    outliers: list[str]
    merged: list[str]
    bridged: list[str]


def import_motion(
    path: Path,
    servo_map: ServoMap,
    *,
    unit: str | None = None,
    bandwidth: float | None = None,
    rate: float | None = None,
    topic: str | None = None,
    trust: bool = False,
) -> tuple[Record, list[SmoothedJoint], list[str]]:
    """Convert recorded joint positions to a record with the signals that a servo map follows.

    Parameters
    ----------
    path : Path
        CSV file, MCAP file with ``sensor_msgs/JointState``, or record with positions.
    servo_map : ServoMap
        Map whose servos name the columns.
    unit : {"rad", "deg", "tick"}, optional
        Unit of columns without a unit; positions in ticks are converted with the map.
    bandwidth : float, optional
        Bandwidth of the smooth motion [Hz]; default: a sixth of the sampling rate, at most 5 Hz.
    rate : float, optional
        Rate of the record [Hz]; default: the rate in the map.
    topic : str, optional
        Topic in an MCAP file; required if it has several with joint states.
    trust : bool, optional
        Accept a record without a valid digest.

    Returns
    -------
    record : Record
        Positions, rates and accelerations. Its summary contains method, bandwidth and differences.
    joints : list of SmoothedJoint
    notes : list of str
        Outliers, repeated samples, gaps, and unused columns.

    Raises
    ------
    RecordError
        If the file is invalid, or its motion cannot be reconstructed; the message states the line.
    """
    rate = servo_map.bus.rate if rate is None else rate
    for name, value, low, high in (("--rate", rate, 1.0, HIGHEST_RATE), ("--bandwidth", bandwidth, 0.1, HIGHEST_RATE)):
        if value is not None and not low <= value <= high:
            raise RecordError(f"{name} must be from {low:g} to {high:g} Hz, got {value:g}")
    recording = _read(path, servo_map, topic, trust)
    # The second servo of a pair follows the same column.
    servos = [servo for servo in servo_map.servos if servo.hold_at is None and servo.joint == servo.axle]
    _check_columns(recording, servos)
    joints = [_smoothed(recording, servo, unit, bandwidth) for servo in servos]
    start, end = max(joint.start for joint in joints), min(joint.end for joint in joints)
    if end - start < 4 * joints[0].step:
        raise RecordError(f"{path}: the joints were not recorded at the same time")
    time = np.linspace(start, end, math.ceil((end - start) * rate - 1e-9) + 1)
    record = Record(time - start, provenance={"imported": str(path)})
    signals: dict[tuple[str, str], list[int]] = {}
    for k, servo in enumerate(servos):
        signals.setdefault((servo.kind.follows.position, servo.kind.follows.velocity), []).append(k)
    for (position, velocity), columns in signals.items():
        labels = tuple(servos[k].label for k in columns)
        for order, (name, si) in enumerate(((position, "rad"), (velocity, "rad/s"), (f"{velocity}dot", "rad/s²"))):
            data = np.column_stack([joints[k].spline(time, order) for k in columns])
            record.add(name, data, si, labels=labels, description="smoothing spline through recorded positions")
    record.summary["import"] = {
        "file": str(path),
        "method": "cubic smoothing spline",
        "bandwidth_Hz": joints[0].bandwidth,
        "sampling_rate_Hz": 1.0 / joints[0].step,
        "joints": {
            joint.joint: {"rms_rad": joint.rms, "max_rad": joint.max, "outliers": len(joint.outliers)}
            for joint in joints
        },
    }
    return record, joints, _notes(recording, servos, joints, start, end)


def _notes(
    recording: Recording, servos: list[MappedServo], joints: list[SmoothedJoint], start: float, end: float
) -> list[str]:
    notes = [f"outlier removed: {text}" for joint in joints for text in joint.outliers]
    notes += [f"gap bridged: {text}" for text in dict.fromkeys(text for joint in joints for text in joint.bridged)]
    if merged := dict.fromkeys(text for joint in joints for text in joint.merged):
        notes.append(f"{len(merged)} repeated sample(s) merged, first at {next(iter(merged))}")
    cut = max(joint.end for joint in joints) - min(joint.start for joint in joints) - (end - start)
    if cut > 2 * joints[0].step:
        notes.append(f"{cut:.3g} s at the ends, in which not all joints were recorded, were cut")
    if unused := [name for name in recording.joints if name not in {servo.label for servo in servos}]:
        notes.append(f"no servo in the map follows {', '.join(unused)}")
    return notes


def _read(path: Path, servo_map: ServoMap, topic: str | None, trust: bool) -> Recording:
    check_file(path, RecordError)
    kind = path.suffix.lower()
    if topic is not None and kind != ".mcap":
        raise RecordError(f"--topic applies to MCAP files, not to {path}")
    if kind == ".mcap":
        return _read_mcap(path, topic)
    if kind == ".csv":
        return _read_csv(path, servo_map.joints)
    if kind in (".h5", ".hdf5"):
        return _read_record(path, servo_map, trust)
    raise RecordError(f"{path}: unknown type {kind or 'without suffix'!r}; import a .csv, .mcap or .h5 file")


def _read_csv(path: Path, known: Collection[str]) -> Recording:
    text = read_text(path, RecordError, SIZE_LIMIT).lstrip("\ufeff")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    header = [cell.strip() for cell in _cells(lines[0])]
    clock, joints = _columns(path, header, known)
    column, scale = clock
    for number, line in enumerate(lines[1:], 2):
        location, cells = f"{path}:{number}", _cells(line)
        if not any(cell.strip() for cell in cells) or line.startswith("#"):
            continue
        if len(cells) != len(header):
            raise RecordError(f"{location}: has {len(cells)} values; the header has {len(header)} columns")
        time = _number(cells[column], f"{location}: {header[column]}")
        if time is None:
            raise RecordError(f"{location}: {header[column]} is empty; every row requires a time")
        for k, samples in joints.items():
            value = _number(cells[k], f"{location}: {header[k]}")
            if value is not None:
                samples.time.append(time * scale)
                samples.value.append(value)
                samples.number.append(number)
    names = {k: _joint_name(_split(header[k])[0], known) for k in joints}
    return Recording(path, ":", {names[k]: samples for k, samples in joints.items()})


def _cells(line: str) -> list[str]:
    """Return the cells of a line; each line is read alone, so that a quote without end spoils one line only."""
    return next(csv.reader([line]), [])


def _number(cell: str, location: str) -> float | None:
    """Return the number in a cell; None if the cell is empty or contains "nan", which recorders write after a fault."""
    text = cell.strip()
    if text.lower() in ("", "nan"):
        return None
    if not NUMBER.fullmatch(text) or not math.isfinite(float(text)):
        raise RecordError(f"{location} = {brief(text)}: must be a finite number with a decimal point")
    return float(text)


def _split(heading: str) -> tuple[str, str]:
    """Return the name and the unit of a heading such as "elbow [rad]"."""
    match = _COLUMN.fullmatch(heading)
    return (match[1], match[2] or "") if match else (heading, "")


def _joint_name(name: str, known: Collection[str]) -> str:
    """Return a known name unchanged, otherwise the joint in "elbow.pos" or "/joint_states/elbow/position"."""
    return name if name in known else re.sub(r"[./](pos|position)$", "", name).rsplit("/", 1)[-1]


def _columns(
    path: Path, header: list[str], known: Collection[str]
) -> tuple[tuple[int, float], dict[int, RecordedSamples]]:
    """Return the time column with the factor to seconds, and the columns with positions."""
    clock: tuple[int, float] | None = None
    joints: dict[int, RecordedSamples] = {}
    names: dict[str, str] = {}
    twice = ""
    for k, heading in enumerate(header):
        name, unit = _split(heading)
        if clock is None and (match := _TIME_COLUMN.fullmatch(name)):
            factor = SECONDS.get(unit or match[2] or "s")
            if factor is None:
                raise RecordError(f"{path}:1: {heading!r}: unknown unit of time; choices: {', '.join(SECONDS)}")
            clock = (k, factor)
        elif (not unit or unit in UNITS) and name:
            joint = _joint_name(name, known)
            twice = twice or (f"columns {names[joint]!r} and {heading!r}" if joint in names else "")
            joints[k], names[joint] = RecordedSamples(UNITS.get(unit, "")), heading
    if clock is None:
        shown = brief(",".join(header))
        raise RecordError(
            f"{path}:1: no column with the time in {shown}; rename that column to 'time [s]', and separate columns by "
            "commas"
        )
    if twice:
        raise RecordError(f"{path}:1: {twice} are positions of the same joint; remove or rename one of them")
    return clock, joints


def _read_mcap(path: Path, topic: str | None) -> Recording:
    try:
        make_reader = importlib.import_module("mcap.reader").make_reader
        typesys = importlib.import_module("rosbags.typesys")
    except ImportError as error:
        raise RecordError(f"MCAP files require mcap and rosbags: pip install 'dynsim[ros]' ({error})") from error
    types = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    topics: dict[str, list[Any]] = {}
    try:
        with path.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages():
                if schema is not None and schema.name == JOINT_STATE and channel.message_encoding == "cdr":
                    topics.setdefault(channel.topic, []).append(message)
    except Exception as error:
        # The reader raises exceptions of several libraries for damaged files.
        raise RecordError(f"{path}: cannot be read as MCAP ({brief(error)}); repair it with `mcap recover`") from error
    if not topics:
        raise RecordError(f"{path}: no topic with {JOINT_STATE} in CDR encoding")
    if topic is None and len(topics) > 1:
        raise RecordError(f"{path}: joint states in {', '.join(topics)}; choose one with --topic")
    if topic is not None and topic not in topics:
        raise RecordError(f"{path}: no joint states in {topic}; topics: {', '.join(topics)}")
    joints: dict[str, RecordedSamples] = {}
    origin: int | None = None
    for number, message in enumerate(topics[topic or next(iter(topics))], 1):
        try:
            state = types.deserialize_cdr(message.data, JOINT_STATE)
        except Exception as error:
            raise RecordError(f"{path}: message {number} is damaged ({brief(error)})") from error
        stamp = state.header.stamp.sec * 1_000_000_000 + state.header.stamp.nanosec or message.log_time
        origin = stamp if origin is None else origin
        if len(state.position) not in (0, len(state.name)):
            raise RecordError(
                f"{path}: message {number} has {len(state.name)} names but {len(state.position)} positions"
            )
        for name, value in zip(state.name, state.position, strict=False):
            if math.isfinite(value):
                samples = joints.setdefault(name, RecordedSamples("rad"))
                samples.time.append((stamp - origin) * 1e-9)
                samples.value.append(float(value))
                samples.number.append(number)
    return Recording(path, ": message ", joints)


def _read_record(path: Path, servo_map: ServoMap, trust: bool) -> Recording:
    record = Record.load(path, trust=trust)
    joints: dict[str, RecordedSamples] = {}
    for name in dict.fromkeys(servo.kind.follows.position for servo in servo_map.servos):
        if name not in record or record[name].ndim != 2 or record.signals[name].axis != TIME:
            continue
        for label, column in zip(record.labels[name], record[name].T, strict=True):
            if (own := record.unit_of(name, label)) != "rad":
                if any(servo.label == label for servo in servo_map.servos):
                    raise RecordError(f"{path}: {label} has unit {own!r}; an import requires 'rad'")
                continue
            known = np.flatnonzero(np.isfinite(column))
            joints[label] = RecordedSamples("rad", record.time[known].tolist(), column[known].tolist(), known.tolist())
    return Recording(path, ": sample ", joints)


def _check_columns(recording: Recording, servos: Iterable[MappedServo]) -> None:
    missing = [servo for servo in servos if servo.label not in recording.joints]
    if missing:
        shown = "; ".join(f"{servo.label} ({servo.entry}){suggest(servo.label, recording.joints)}" for servo in missing)
        raise RecordError(
            f"{recording.path}: no positions of {shown}; it has {first_few(list(recording.joints)) or 'none'}; "
            "rename the columns, or set 'label' in the map"
        )


def _smoothed(recording: Recording, servo: MappedServo, unit: str | None, bandwidth: float | None) -> SmoothedJoint:
    """Return the smooth motion of one joint."""
    from scipy.interpolate import make_smoothing_spline

    samples, label = recording.joints[servo.label], servo.label
    unit = samples.unit or unit
    if unit is None:
        raise RecordError(
            f"{recording.location(1)}: column {label!r} has no unit; use --unit rad, --unit deg or --unit tick"
        )
    kept, merged = _in_order(recording, label)
    number = np.array(samples.number)[kept]
    time = np.array(samples.time)[kept]
    value = np.array(samples.value)[kept]
    if unit != "rad":
        value = (
            np.radians(value) if unit == "deg" else servo.sign * (value - servo.zero_tick) * RAD_PER_TICK / servo.gear
        )
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if len(time) < FEWEST:
        raise RecordError(f"{recording.path}: {label} has {len(time)} samples; a motion requires {FEWEST} or more")
    if not LOWEST_RATE <= 1.0 / step <= HIGHEST_RATE:
        raise RecordError(
            f"{recording.path}: {label} is sampled at {1.0 / step:.3g} Hz (from {LOWEST_RATE:g} to {HIGHEST_RATE:g} "
            "Hz can be imported); correct the unit of the time column, such as 'time [ms]'"
        )
    cutoff = min(BANDWIDTH, 1.0 / step / BANDWIDTH_SHARE) if bandwidth is None else bandwidth
    if cutoff > 0.5 / step * (1 + 1e-6):
        raise RecordError(f"--bandwidth must be at most half of the sampling rate, {0.5 / step:.4g} Hz, got {cutoff:g}")
    spikes = outliers(time, value)
    if spikes.mean() > OUTLIER_SHARE:
        raise RecordError(
            f"{recording.location(number[spikes.argmax()])}: {spikes.sum()} of {len(value)} samples of {label} are "
            f"outliers (limit {OUTLIER_SHARE:.0%}); repair the sensor or record again"
        )
    removed = [
        f"{recording.location(number[k])}: {label} = {value[k]:.4f} rad at t = {time[k] - time[0]:.3f} s"
        for k in np.flatnonzero(spikes)
    ]
    number, time, value = number[~spikes], time[~spikes], value[~spikes]
    longest = min(1.0 / cutoff, max(1.0 / BANDWIDTH, BANDWIDTH_SHARE * step))
    bridged = _gaps(recording, label, number, time, step, longest)
    weight = 1.0 / (step * (2.0 * np.pi * cutoff) ** 4)
    spline = make_smoothing_spline(time, value, lam=weight)
    error = spline(time) - value
    worst = int(np.abs(error).argmax())
    if abs(error[worst]) > DEVIATION:
        near = slice(max(0, worst - 1), worst + 2)
        jump = float(np.abs(np.diff(value[near])).max())
        raise RecordError(
            f"{recording.location(number[worst])}: the smooth motion of {label} would deviate by "
            f"{abs(error[worst]):.3g} rad (limit {DEVIATION:g} rad) from the sample, which is {jump:.3g} rad from its "
            "neighbour; use a higher --bandwidth, or cut or unwrap the recording if the position jumps there"
        )
    rms = float(np.sqrt(np.mean(error**2)))
    ends = float(time[0]), float(time[-1])
    return SmoothedJoint(
        servo.joint, spline, *ends, step, cutoff, rms, abs(float(error[worst])), removed, merged, bridged
    )


def _in_order(recording: Recording, label: str) -> tuple[list[int], list[str]]:
    """Return the indices of the samples with increasing times, and the locations of repeated samples."""
    samples = recording.joints[label]
    kept: list[int] = []
    merged = []
    for k, time in enumerate(samples.time):
        last = kept[-1] if kept else None
        if last is None or time > samples.time[last]:
            kept.append(k)
            continue
        location, before = recording.location(samples.number[k]), recording.location(samples.number[last])
        if time < samples.time[last]:
            raise RecordError(
                f"{location}: the time decreases by {samples.time[last] - time:.3g} s after {before}; "
                "sort the rows by time"
            )
        if samples.value[k] != samples.value[last]:
            raise RecordError(
                f"{location}: {label} has the same time as at {before}, but another position "
                f"({samples.value[k]:.6g}, was {samples.value[last]:.6g}); remove one of the rows"
            )
        merged.append(location)
    return kept, merged


def outliers(time: Array, value: Array) -> NDArray[np.bool_]:
    """Return True for the samples that differ from their neighbours like a read error.

    Each sample is compared with the median of three linear interpolations: between its neighbours, its second and its
    third neighbours. The difference counts as an outlier if it is far larger than usual in its surroundings, and larger
    than the motion from the three samples before to the three samples after it, so that a step is not an outlier.

    Parameters
    ----------
    time, value : (T,) ndarray
        Times [s] and positions [rad]; at least :data:`FEWEST` samples.
    """
    from scipy.ndimage import median_filter

    expected = np.full((3, len(value)), np.nan)
    expected[0, [0, -1]] = value[[0, -1]]
    for j in (1, 2, 3):
        before, at, after = slice(None, -2 * j), slice(j, -j), slice(2 * j, None)
        share = (time[at] - time[before]) / (time[after] - time[before])
        expected[j - 1, at] = value[before] + share * (value[after] - value[before])
    error = np.abs(value - np.nanmedian(expected, axis=0))
    around = sliding_window_view(np.pad(value, 3, mode="edge"), 7)
    moved = np.abs(np.median(around[:, 4:], axis=1) - np.median(around[:, :3], axis=1))
    usual = np.maximum(SPIKE, SPIKE_SCALE * 1.4826 * median_filter(error, SPIKE_WINDOW))
    return np.asarray(error > np.maximum(usual, moved))


def _gaps(
    recording: Recording, label: str, number: NDArray[np.int64], time: Array, step: float, longest: float
) -> list[str]:
    """Return the gaps that the spline bridges; raise RecordError for a gap longer than ``longest`` [s]."""
    steps, texts = np.diff(time), []
    for k in np.flatnonzero(steps > LONG_STEP * step):
        texts.append(f"{recording.location(number[k + 1])}: no sample for {steps[k]:.3g} s after {number[k]}")
        if steps[k] > longest:
            problem = f"the motion of {label} is unknown (limit {longest:.3g} s); cut the recording"
            raise RecordError(f"{texts[-1]}, so {problem}")
    return texts
