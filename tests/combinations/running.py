"""Runs of a scene: with each method that supports all of its features, and in one of several ways."""

from __future__ import annotations

import math
import tempfile
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from combinations.factors import STARTS
from combinations.scenes import Scene
from dynsim import Simulation, check, simulate, simulate_batch
from dynsim.engine.prepare import prepare
from dynsim.errors import DynsimError, SimulationInterrupted, SimulationStopped
from dynsim.record import Record
from dynsim.scenario import Scenario, build, build_model
from dynsim.scenario.reading import scenario_from_resolved

M_STAR = "m_star"
# Shares of the duration at which a run in pieces stops: one within the first step, two close together.
PIECES = (1e-6, 0.1234, 0.4, 0.400001, 0.77)


@dataclass(frozen=True)
class Run:
    """One run of a scene with a method, in one of several ways.

    Attributes
    ----------
    scenario : content of a scenario file, with the method
    resolved : the scenario as dynsim read it; None if reading failed
    method : ``auto``, ``dopri5``, ``radau5`` or ``time_stepping``
    way : ``simulate``, ``pieces``, ``snapshot``, ``batch``, or ``m_star``, a simulation with that solver
    record : the record; None if the run was refused or stopped before the first sample
    error : the error that refused or stopped the run
    warnings : warnings in the record's summary
    checked : the message with which ``check`` refused the scenario; None if it passed
    """

    scenario: Mapping[str, Any]
    resolved: Scenario | None
    method: str
    way: str
    record: Record | None
    error: Exception | None
    warnings: list[str] = field(default_factory=list)
    checked: str | None = None

    @property
    def begun(self) -> bool:
        """Whether there is a sample: a run that stops before its first one has not begun."""
        return self.record is not None and len(self.record) > 0

    @property
    def status(self) -> str:
        """``finished``, ``refused``, the kind of a stop, or the class of an error that is not a DynsimError."""
        if self.error is None:
            return "finished"
        if isinstance(self.error, SimulationStopped):
            return self.error.kind or "stopped"
        return "refused" if isinstance(self.error, DynsimError) else type(self.error).__name__


def run(scene: Scene, method: str, manner: str = "simulate") -> Run:
    """Check a scene and run it; keep any error in the result."""
    solver = M_STAR if manner == M_STAR else "articulated"
    settings = scene.with_method(method, solver)
    try:
        scenario = scene.load(method, solver)
    except DynsimError as error:
        return Run(settings, None, method, manner, None, error, [], str(error))
    checked, record, failure = None, None, None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            check(scenario)
        except DynsimError as error:
            checked = str(error)
        try:
            record = WAYS[manner](scenario)
        except SimulationInterrupted:
            raise
        except SimulationStopped as stop:
            record, failure = stop.record, stop
        except Exception as error:  # a fault of dynsim in one scene must not keep the others from running
            failure = error
    said = list(record.summary["warnings"]) if record is not None else []
    return Run(settings, scenario, method, manner, record, failure, said, checked)


def _simulation(scenario: Scenario) -> Simulation:
    """Return a simulation like that of ``simulate``; with Python ticks it has no end time, which would cut a step."""
    sensors, controller = scenario.config.sensors, scenario.controller
    read = sensors is not None and not (sensors.encoders is None and sensors.motion_capture is None)
    attended = read or getattr(controller, "operator", None) is not None
    attended = attended or getattr(controller, "type", "") == "task_space"
    simulation = Simulation(scenario, duration=math.inf if attended else None)
    if attended:
        simulation.end_samples(scenario.duration_s)
    return simulation


def _in_pieces(scenario: Scenario) -> Record:
    simulation = _simulation(scenario)
    for share in PIECES:
        simulation.advance(share * scenario.duration_s)
    simulation.advance(scenario.duration_s)
    return simulation.record(scenario)


def _with_snapshot(scenario: Scenario) -> Record:
    """Continue a simulation, restore an earlier snapshot, and continue from it again."""
    simulation = _simulation(scenario)
    simulation.advance(0.3 * scenario.duration_s)
    snapshot = simulation.snapshot()
    simulation.advance(0.8 * scenario.duration_s)
    simulation.restore(snapshot)
    simulation.advance(scenario.duration_s)
    return simulation.record(scenario)


def _in_a_batch(scenario: Scenario) -> Record:
    """Run the scenario in a batch next to an equal scenario, with which it shares data."""
    first, second = simulate_batch([scenario, scenario], keep_records="all")
    for result in (first, second):
        if result.record is None:
            # Raise the error itself, because a batch returns only its message.
            return simulate(scenario)
    assert first.record is not None
    assert second.record is not None
    differ = different(first.record, second.record)
    assert not differ, f"two runs of a batch differ in {differ}"
    if not first.ok:
        return simulate(scenario)
    return second.record


WAYS = {
    "simulate": simulate,
    "pieces": _in_pieces,
    "snapshot": _with_snapshot,
    "batch": _in_a_batch,
    M_STAR: simulate,
}


def runs(scene: Scene, takes: Callable[[str, str], bool] = lambda method, manner: True) -> dict[str, Run]:
    """Run a scene with all its methods (key ``METHOD``) and in further ways (key ``METHOD/WAY``).

    ``auto`` chooses one of the methods; it runs only if the scene does not run in a further way. ``takes`` may exclude
    methods and ways.
    """
    done = {method: run(scene, method) for method in scene.methods if method != "auto" and takes(method, "simulate")}
    if not done:
        return {}
    # The method that runs in a further way changes from scene to scene.
    method = sorted(done)[scene.seed % len(done)]
    manner = scene.levels["way"]
    if manner != "simulate":
        done[f"{method}/{manner}"] = run(scene, method, manner)
    elif "auto" in scene.methods and takes("auto", manner):
        done["auto"] = run(scene, "auto")
    able = sorted(set(done) & {"dopri5", "radau5"})
    if scene.levels["solver"] == M_STAR and able and takes(able[scene.seed % len(able)], M_STAR):
        method = able[scene.seed % len(able)]
        done[f"{method}/{M_STAR}"] = run(scene, method, M_STAR)
    return done


def faults(scene: Scene, done: Mapping[str, Run], *, thorough: bool = False) -> list[tuple[str, str]]:
    """Return the faults in the starts, ends and saved results of runs, as (kind, sentence).

    Parameters
    ----------
    thorough : bool
        Whether to repeat the resolved scenario, continue from a state, save and load the record, draw figures and page,
        and export.
    """
    wrong: list[tuple[str, str]] = []
    for name, own in done.items():
        wrong += [(kind, f"{name}: {text}") for kind, text in _began(scene, own)]
        same, _, manner = name.partition("/")
        if manner and manner != M_STAR and (differ := _differs(done[same], own)):
            wrong.append(("way", f"{name} is not {same}: {differ}"))
    if (auto := done.get("auto")) is not None and auto.record is not None:
        same = str(auto.record.summary["method"])
        assert auto.resolved is not None
        differ = _differs(done[same], auto) if same in done else ""
        # For undamped motion ``auto`` uses tighter tolerances.
        if differ and prepare(auto.resolved).choice.sharper == 1.0:
            wrong.append(("way", f"auto is not {same}: {differ}"))
    if thorough:
        for name, own in done.items():
            if "/" not in name and own.record is not None:
                wrong += [(kind, f"{name}: {text}") for kind, text in _kept(own)]
    return wrong


def _began(scene: Scene, own: Run) -> list[tuple[str, str]]:
    """Return faults if ``check`` and the run disagree, a valid start is refused, or an unexpected error occurs."""
    stopped = isinstance(own.error, SimulationStopped)
    refused = isinstance(own.error, DynsimError) and not (stopped and own.begun)
    if own.error is not None and not isinstance(own.error, DynsimError):
        return [("crash", f"{type(own.error).__name__}: {own.error}")]
    if own.checked is None and refused:
        return [("check", f"passes, but the run says: {own.error}")]
    if own.checked is not None and not refused:
        return [("check", f"the run begins, but check says: {own.checked}")]
    if refused and not stopped and not expected(scene, str(own.error)):
        return [("refused", str(own.error))]
    return []


def expected(scene: Scene, text: str) -> bool:
    """Whether an error belongs to a start that may fail, depending on the numbers of the scene."""
    import re

    pattern = STARTS.get(scene.levels["start"])
    return pattern is not None and re.search(pattern, " ".join(text.split())) is not None


def _differs(a: Run, b: Run) -> str:
    """Return the difference of two runs that should be bit-identical; empty if they are.

    The progress of a run until its wall limit depends on the machine: then the samples that both have are compared.
    """
    late = "out_of_time" in (a.status, b.status)
    if a.status != b.status and not late:
        return f"{a.status}, {b.status}: {b.error or a.error}"
    if a.record is None or b.record is None:
        return ""
    names = different(a.record, b.record, min(len(a.record.time), len(b.record.time)) if late else None)
    return f"different {', '.join(names)}" if names else ""


def different(a: Record, b: Record, samples: int | None = None) -> list[str]:
    """Return the names of the signals that are not bit-identical, in the first ``samples`` or in all."""
    names = sorted({*a, *b})
    return [
        name
        for name in names
        if name not in a
        or name not in b
        or not np.array_equal(np.asarray(a[name])[:samples], np.asarray(b[name])[:samples], equal_nan=True)
    ]


def _kept(own: Run) -> list[tuple[str, str]]:
    """Return faults in runs of the resolved scenario and from a state, the saved record, figures, page and exports."""
    assert own.resolved is not None
    assert own.record is not None
    wrong: list[tuple[str, str]] = []
    again = _again(own)
    if differ := _differs(own, again):
        wrong.append(("repeat", f"its resolved scenario: {differ}"))
    if said := _goes_on(own):
        wrong.append(("state", said))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, keep in KEPT.items():
            try:
                said = keep(own, Path(folder))
            except Exception as error:
                said = f"{type(error).__name__}: {error}"
            if said:
                wrong.append((name, said))
    return wrong


def _goes_on(own: Run) -> str:
    """Start another simulation from the state of one in the middle of its run: it must begin in that state."""
    assert own.resolved is not None
    duration = own.resolved.duration_s
    try:
        state = _simulation(own.resolved).advance(0.4 * duration)
        simulation = Simulation(own.resolved, state=state)
        simulation.advance(0.41 * duration)
    except DynsimError:
        # The run itself may stop, and not every controller continues from a state.
        return ""
    # Time stepping moves joints back to stops, and points to surfaces, that they have passed.
    off = float(np.abs(simulation.record()["q"][0] - state.q).max(initial=0.0))
    return f"a run from its state at {state.time:.6g} s begins {off:.3g} off" if off > 1e-6 else ""


def _again(own: Run) -> Run:
    assert own.resolved is not None
    assert own.record is not None
    failure, record = None, None
    try:
        record = simulate(scenario_from_resolved(own.record.provenance["scenario"]))
    except SimulationStopped as stop:
        record, failure = stop.record, stop
    except DynsimError as error:
        failure = error
    return Run(own.scenario, own.resolved, own.method, own.way, record, failure)


def _save(own: Run, folder: Path) -> str:
    assert own.record is not None
    own.record.save(folder / "record.h5")
    differ = different(own.record, Record.load(folder / "record.h5"))
    return f"loaded with other {', '.join(differ)}" if differ else ""


def _draw(own: Run, folder: Path) -> str:
    from dynsim.draw.figures import draw

    assert own.record is not None
    return "" if draw(own.record, folder / "figures") else "no figure"


def _page(own: Run, folder: Path) -> str:
    from dynsim.draw import page

    assert own.record is not None
    page.write({"run": own.record}, folder / "view.html")
    return ""


def _export(own: Run, folder: Path) -> str:
    from dynsim.record.joint_motion import export_record
    from dynsim.record.mcap_file import write_mcap

    assert own.record is not None
    # A motion needs more than one sample.
    if len(own.record) > 1:
        export_record(own.record, folder / "run.csv", "csv")
    write_mcap(own.record, folder / "run.mcap")
    return ""


def _describe(own: Run, folder: Path) -> str:
    """Convert the model to URDF, which does not support wheels that roll without slip, and to MJCF."""
    assert own.resolved is not None
    model = build_model(own.resolved)
    scene = build.contacts(own.resolved), build.surfaces(own.resolved)
    for text in (model.to_urdf, lambda: model.to_mjcf(*scene, touching=True)):
        with suppress(DynsimError):
            text()
    return ""


KEPT = {"save": _save, "figures": _draw, "page": _page, "export": _export, "describe": _describe}
