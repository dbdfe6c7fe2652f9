"""Sweeps: the set of runs, equality with single runs, and runs that survive an interruption."""

import csv
import itertools
import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from support.messages import mentions, raises
from support.processes import started, wait_for
from support.sweep_work import DEADLY, REFUSED, attentive, deaf, leaves, once_deadly, square, warned

import dynsim
from dynsim.cli import sweep as sweep_command
from dynsim.cli.sweep import drawn_table
from dynsim.config.problems import OptionKey
from dynsim.draw.figures import style
from dynsim.draw.figures import sweep as pictures
from dynsim.draw.figures.look import Look
from dynsim.errors import DynsimError, ScenarioError
from dynsim.record import Record
from dynsim.record.quantities import ENERGY, Quantity
from dynsim.record.sensitivity import sensitivities, spread
from dynsim.scenario import read_scenario
from dynsim.studies import batch
from dynsim.studies import sweep as module
from dynsim.studies.processes import WorkerInterrupted, WorkerLost, run_in_processes
from dynsim.studies.sweep import JOURNAL, LOST, SweepRow, numbers, run_sweep
from dynsim.studies.sweep_plan import Axis, Law, Plan
from dynsim.system.terminal import Terminal

PENDULUM = read_scenario("single_pendulum")
SHORT = {"duration_s": 0.2}
LENGTH = "plant.chain.0.length_m"
# No link has the second.
MASSES = Axis("plant.chain.0.mass_kg", (1.0, -1.0, 2.0))


def plan(*grid: Axis, laws: tuple[Law, ...] = (), count: int = 1, seed: int = 0) -> Plan:
    return Plan(PENDULUM, (None,), SHORT, grid, laws, count, seed)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("a.b=0:1:5", (0.0, 0.25, 0.5, 0.75, 1.0)),
        ("a=0.1:0.4:4", (0.1, 0.2, 0.3, 0.4)),
        ("a=-1e-3:1e-3:3", (-1e-3, 0.0, 1e-3)),
        ("a=0.1,0.2", (0.1, 0.2)),
        ("a=dopri5,radau5", ("dopri5", "radau5")),
        ("a=3", (3,)),
        ("a=[0, 1],[1, 0]", ([0, 1], [1, 0])),
    ],
)
def test_values_of_a_grid(text: str, values: tuple[Any, ...]):
    assert Axis.parse(text).values == values


@pytest.mark.parametrize(
    ("make", "names"),
    [
        (lambda: Axis.parse("contacts.friction"), "--grid contacts.friction contacts.friction=0:1:5"),
        (lambda: Axis.parse("a=0:1:1"), "--grid a=0:1:1 2 10000000"),
        (lambda: Axis.parse("a=1,1"), "--grid a=1,1"),
        (lambda: Axis.parse("a=0:0.5"), "--grid a=0:0.5 start:stop:count a=0:0.5:5"),
        (lambda: Axis.parse("a=0:0.5:0.1"), "--grid a=0:0.5:0.1 start:stop:count a=0:0.5:5"),
        (lambda: Law.parse("a=cauchy(0,1)"), "--sample a=cauchy(0,1) normal uniform"),
        (lambda: Law.parse("a=normal(1,0)"), "--sample a=normal(1,0)"),
        (lambda: Law.parse("a=uniform(2,1)"), "--sample a=uniform(2,1)"),
        (lambda: plan(), "--grid --sample --variants"),
        (
            lambda: plan(MASSES, MASSES),
            "--grid plant.chain.0.mass_kg",
        ),
        (lambda: plan(MASSES, count=3), "--count --sample"),
        (
            lambda: list(plan(laws=(Law.parse("loads.*.mass_kg=uniform(1,2)"),)).points()),
            "loads.*.mass_kg single_pendulum.yaml *",
        ),
        (lambda: Law.parse("k=uniform(-1e308,1e308)"), "--sample k=uniform(-1e308,1e308)"),
        (lambda: Axis.parse("k=0:1:999999999999"), "--grid k=0:1:999999999999 2 10000000"),
    ],
)
def test_what_is_no_sweep_is_refused(make: Callable[[], Any], names: str):
    with raises(ScenarioError, *names.split()):
        make()


def test_printed_table_has_warnings_of_each_kind_and_no_rounding_errors(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delenv("COLUMNS", raising=False)
    texts = (
        "the battery is empty after {0} s; use a larger one\nlink_{0} slips on the floor",
        "link_{0} slips on the floor",
    )
    rows = [
        SweepRow(k, None, {LENGTH: 1.0 + k}, "ok", "", {ENERGY: value}, texts[k % 2].format(k))
        for k, value in enumerate([4.0, 1e-12, -3.5e-17, 4.0])
    ]
    monkeypatch.setattr(sweep_command, "console", Terminal(emoji=False))  # a pipe without COLUMNS
    sweep_command._print_table("pendulum", rows, plan(Axis(LENGTH, (1.0, 2.0, 3.0, 4.0))), ())
    printed = capsys.readouterr().out
    assert [line.split()[-1] for line in printed.splitlines() if re.match(r"  [0-3] ", line)] == ["4", "0", "0", "4"]
    assert "warning: 4 of 4 runs: link_0 slips on the floor (the first of 4)\n" in printed
    assert "warning: run 0, run 2: the battery is empty after 0 s; use a larger one (the first of 2)\n" in printed
    assert "sweep.csv" in printed.splitlines()[-1]
    assert rows[0].cells()["warnings"] == "the battery is empty after 0 s; use a larger one; link_0 slips on the floor"


CHAIN = read_scenario("link_tolerance")
FIFTH, ANY_LINK = "plant.chain.5.mass_kg", "plant.chain.*.mass_kg"


@pytest.mark.parametrize(
    ("fixed", "grid", "drawn", "replacing", "replaced"),
    [
        ({}, [FIFTH], [ANY_LINK], f"--sample {ANY_LINK}", f"--grid {FIFTH}"),
        ({}, [ANY_LINK], [FIFTH], f"--sample {FIFTH}", f"--grid {ANY_LINK}"),
        ({}, [FIFTH, ANY_LINK], [], f"--grid {ANY_LINK}", f"--grid {FIFTH}"),
        ({}, [], [FIFTH, ANY_LINK], f"--sample {ANY_LINK}", f"--sample {FIFTH}"),
        ({}, ["plant.chain.05.mass_kg"], [ANY_LINK], f"--sample {ANY_LINK}", "--grid plant.chain.05.mass_kg"),
        ({}, [FIFTH, "plant.chain.5"], [], "--grid plant.chain.5", f"--grid {FIFTH}"),
        ({FIFTH: 0.1}, [ANY_LINK], [], f"--grid {ANY_LINK}", f"--set {FIFTH}"),
        ({FIFTH: 0.1}, [], [FIFTH], f"--sample {FIFTH}", f"--set {FIFTH}"),
    ],
)
def test_a_key_that_replaces_another_is_refused(
    fixed: dict[str, Any], grid: list[str], drawn: list[str], replacing: str, replaced: str
):
    axes = tuple(Axis(key, (0.1, 0.2)) for key in grid)
    laws = tuple(Law(key, "normal", (0.1, 0.01)) for key in drawn)
    with raises(ScenarioError, replacing, replaced) as refused:
        Plan(CHAIN, (None,), {OptionKey(key): value for key, value in fixed.items()}, axes, laws)
    message = str(refused.value)
    assert message.startswith(f"{replacing}: ")
    # What the other leaves of the entries that * stands for is said.
    assert (" * " in message) == ("*" in message)


def test_a_part_of_what_was_given_may_be_varied():
    whole, law = (
        Axis("plant.link", ({"length_m": 0.1}, {"length_m": 0.2})),
        Law("plant.link.mass_kg", "normal", (1.0, 0.1)),
    )
    assert Plan(CHAIN, (None,), {OptionKey("plant"): {}}, (whole,), (law,)).runs == 2
    # The base of a sweep from Python.
    assert Plan(CHAIN, (None,), {FIFTH: 0.1}, (Axis(FIFTH, (0.1, 0.2)),)).runs == 2


def test_runs_are_variants_by_grid_by_samples():
    law = Law.parse("plant.link.mass_kg=normal(0.1,0.005)")
    swept = Plan(read_scenario("elbow_comparison"), ("elbow_7", "no_elbow"), {}, (Axis.parse("a=1,2"),), (law,), 3)
    points = list(swept.points())
    assert [point.run for point in points] == list(range(swept.runs)) == list(range(12))
    assert [point.variant for point in points] == ["elbow_7"] * 6 + ["no_elbow"] * 6
    assert [point.values["a"] for point in points[:6]] == [1, 1, 1, 2, 2, 2]
    # The same samples at every place, so that places differ by nothing else.
    drawn = [point.values[law.key] for point in points]
    assert drawn == drawn[:3] * 4
    assert len(set(drawn)) == 3


def test_samples_depend_on_their_key_and_seed_alone():
    mass, damping = Law("m", "normal", (1.0, 0.1)), Law("d", "uniform", (0.0, 1.0))

    def drawn(*laws: Law, count: int = 4, seed: int = 1) -> list[Any]:
        return [point.values["m"] for point in plan(laws=laws, count=count, seed=seed).points()]

    assert drawn(mass) == drawn(damping, mass) == drawn(mass, count=9)[:4]
    assert drawn(mass) != drawn(mass, seed=2)


def test_a_star_is_every_entry():
    file = read_scenario("elbow_comparison")
    law, axis = Law.parse("contacts.points.*.friction=uniform(0,1)"), Axis.parse("surfaces.*.normal=[0,0,1],[0,0,2]")
    swept = Plan(file, ("two_elbows",), {}, (axis,), (law,), 2)
    keys = [f"contacts.points.{name}.friction" for name in ("elbow_4", "elbow_7")]
    assert swept.parameters == [axis.key, *keys]
    point = list(swept.points())[3]
    config = swept.scenario(point).config
    assert list(config.surfaces["floor"].normal) == [0, 0, 2]
    frictions = [contact.friction for contact in config.contacts.points.values()]
    assert frictions == [point.values[key] for key in keys]
    assert frictions[0] != frictions[1]


@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_sensitivities_find_the_line(seed: int, size: int):
    generator = np.random.default_rng(seed)
    parameters = generator.normal(size=(30, size)) * 10.0 ** generator.uniform(-3, 3, size)
    slopes = generator.normal(size=size) / parameters.std(axis=0, ddof=1)
    fit = sensitivities(parameters, 3.0 + parameters @ slopes)
    assert fit is not None
    np.testing.assert_allclose(fit.effect, slopes * parameters.std(axis=0, ddof=1), rtol=1e-8, atol=1e-10)
    assert fit.explained == pytest.approx(1.0, abs=1e-10)


def test_intervals_are_those_of_linear_regression():
    generator = np.random.default_rng(3)
    x = generator.normal(size=25)
    y = 2.0 * x + generator.normal(size=25)
    fit, reference = sensitivities(x[:, None], y), scipy.stats.linregress(x, y)
    assert fit is not None
    half = scipy.stats.t.ppf(0.975, 23) * reference.stderr * x.std(ddof=1)
    assert fit.effect[0] == pytest.approx(reference.slope * x.std(ddof=1), rel=1e-12)
    assert fit.half_width[0] == pytest.approx(half, rel=1e-12)
    assert fit.explained == pytest.approx(reference.rvalue**2, rel=1e-12)
    interval = spread(y)
    expected = scipy.stats.t.interval(0.95, 24, loc=y.mean(), scale=scipy.stats.sem(y))
    assert (interval.mean_low, interval.mean_high) == pytest.approx(expected, rel=1e-12)


def test_no_line_where_there_is_none():
    x = np.arange(6.0)[:, None]
    assert sensitivities(x, np.ones(6)) is None
    assert sensitivities(np.ones((6, 1)), x[:, 0]) is None
    assert sensitivities(np.hstack([x, 2.0 * x]), x[:, 0]) is None
    assert sensitivities(x[:2], x[:2, 0]) is None


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1))
def test_the_pareto_front_is_what_no_run_beats(points: list[tuple[int, int]]):
    def beaten(point: tuple[int, int]) -> bool:
        return any(x <= point[0] and y <= point[1] and (x, y) != point for x, y in points)

    assert {tuple(point) for point in pictures.best(points)} == {
        candidate for candidate in points if not beaten(candidate)
    }


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_batch_gives_what_single_runs_give(jobs: int):
    scenarios = [dynsim.load_scenario("single_pendulum", overrides=SHORT | {LENGTH: length}) for length in (0.5, 1.0)]
    # Refused, which is no reason not to run the last.
    scenarios.insert(1, dynsim.load_scenario("single_pendulum", overrides=SHORT | {"integrator.wall_limit_s": 1e-9}))
    finished: dict[int, Any] = {}
    results = dynsim.simulate_batch(
        scenarios, jobs=jobs, keep_records="all", finished=lambda k, result: finished.update({k: result})
    )
    assert [finished[k] for k in range(3)] == results
    assert [result.ok for result in results] == [True, False, True]
    assert "wall_limit_s" in results[1].reason
    for scenario, result in zip(scenarios[::2], results[::2], strict=True):
        alone = dynsim.simulate(scenario)
        assert numbers(result.summary) == numbers(alone.summary)
        np.testing.assert_array_equal(result.record["q"], alone["q"])
        assert result.record.scene == alone.scene


@pytest.mark.parametrize(
    ("options", "message"),
    [({"jobs": 0}, "jobs = 0"), ({"keep_records": "some"}, "keep_records"), ({"scheduler": "nowhere"}, "Dask")],
)
def test_a_batch_that_cannot_run_is_refused(options: dict[str, Any], message: str):
    with pytest.raises(DynsimError, match=message):
        dynsim.simulate_batch([dynsim.load_scenario("single_pendulum", overrides=SHORT)], **options)


def test_a_process_that_dies_costs_only_its_task():
    taken: dict[int, Any] = {}

    def take(number: int, result: Callable[[], int]) -> None:
        try:
            taken[number] = result()
        except (WorkerLost, ValueError) as error:
            taken[number] = type(error)

    assert run_in_processes(square, range(10), 2, take, attempts=2) is False
    expected = {number: number**2 for number in range(10)} | {DEADLY: WorkerLost, REFUSED: ValueError}
    assert taken == expected


def test_a_task_outlives_the_process_that_it_had_first(tmp_path: Path):
    taken: dict[int, int] = {}
    tasks = [(number, str(tmp_path)) for number in range(8)]
    run_in_processes(once_deadly, tasks, 2, lambda task, result: taken.update({task[0]: result()}), attempts=2)
    assert (tmp_path / "seen").exists()
    assert taken == {number: number**2 for number in range(8)}


def test_ctrl_c_does_not_wait_for_who_does_not_look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Both workers sleep for longer than any test; what they had in hand is interrupted."""
    taken: dict[int, Any] = {}

    def take(task: tuple[int, str], result: Callable[[], int]) -> None:
        with pytest.raises(WorkerInterrupted):
            result()
        taken[task[0]] = None

    assert interrupted(deaf, tmp_path, take, lambda _: os.kill(os.getpid(), signal.SIGINT)) is True
    assert taken == {0: None, 1: None}


def interrupted(
    work: Callable[[Any, Any], int], folder: Path, take: Callable[..., None], interrupt: Callable[[list[Path]], None]
) -> bool:
    """Give four tasks to two workers, and call ``interrupt`` when both have begun."""

    def wait() -> None:
        wait_for(lambda: len(list(folder.glob("begun_*"))) == 2)
        interrupt(list(folder.glob("begun_*")))

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    Thread(target=wait, daemon=True).start()
    try:
        return run_in_processes(work, [(number, str(folder)) for number in range(4)], 2, take)
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="no signal stops a process here")
def test_ctrl_c_waits_for_a_process_that_gets_no_time(tmp_path: Path):
    """As on a busy machine: one is stopped for two seconds and returns its result then."""
    taken: dict[int, int] = {}

    def interrupt(begun: list[Path]) -> None:
        stalled = int(begun[0].name.removeprefix("begun_"))
        os.kill(stalled, signal.SIGSTOP)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(2.0)
        os.kill(stalled, signal.SIGCONT)

    assert interrupted(attentive, tmp_path, lambda task, result: taken.update({task[0]: result()}), interrupt) is True
    assert taken == {0: 0, 1: 1}


def test_a_process_that_leaves_a_thread_behind_is_replaced():
    """Its task is done, and so are the others, none of them by it."""
    taken: dict[int, int] = {}
    run_in_processes(leaves, range(10), 1, lambda number, result: taken.update({number: result()}))
    assert len(taken) == 10
    left = taken[DEADLY]
    assert all(taken[number] == left for number in range(DEADLY))
    assert all(taken[number] != left for number in range(DEADLY + 1, 10))


def test_a_lost_process_is_a_row_with_its_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """What a sweep makes of it: the other runs are there."""

    def lose() -> None:
        raise WorkerLost

    def run(work: Any, tasks: Any, jobs: int, take: Any, *, attempts: int, here: Any) -> bool:
        for k, task in enumerate(tasks):
            take(task, lose if k == 1 else partial(work, task, None))
        return False

    monkeypatch.setattr(batch, "run_in_processes", run)
    rows = run_sweep(plan(Axis.parse(f"{LENGTH}=0.5:1:3")), tmp_path, jobs=2)
    assert [row.status for row in rows] == ["ok", "lost", "ok"]
    assert mentions(rows[1].reason, "killed")


@pytest.mark.parametrize("listens", [True, False])
def test_workers_make_messages_only_for_who_listens(listens: bool, monkeypatch: pytest.MonkeyPatch):
    heard: list[str] = []

    class Ear(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            heard.append(record.getMessage())

    library = logging.getLogger("dynsim")
    # Those of pytest are at the root.
    monkeypatch.setattr(library, "propagate", False)
    monkeypatch.setattr(library, "handlers", [logging.NullHandler(), *([Ear()] if listens else [])])
    made: dict[int, bool] = {}
    run_in_processes(warned, range(3), 1, lambda number, result: made.update({number: result()}))
    assert made == dict.fromkeys(range(3), listens)
    assert sorted(heard) == ([f"number {number}" for number in range(3)] if listens else [])


def test_the_table_has_every_run_whatever_the_jobs(tmp_path: Path):
    swept = plan(Axis.parse(f"{LENGTH}=0.5:1:3"), MASSES)
    serial = run_sweep(swept, tmp_path / "one")
    assert run_sweep(swept, tmp_path / "two", jobs=2) == serial
    for name in module.TABLES[: 1 + module.has_parquet()]:
        assert (tmp_path / "two" / name).read_bytes() == (tmp_path / "one" / name).read_bytes()
    with (tmp_path / "one" / "sweep.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [row["status"] for row in table] == ["ok", "failed", "ok"] * 3
    assert "mass_kg = -1.0" in table[1]["reason"]
    for row, point in zip(table, swept.points(), strict=True):
        assert (float(row[LENGTH]), float(row[MASSES.key])) == (point.values[LENGTH], point.values[MASSES.key])
        if row["status"] == "ok":
            summary = dynsim.simulate(swept.scenario(point)).summary
            assert all(float(row[key]) == value for key, value in numbers(summary).items())


def test_an_error_in_a_sweep_leaves_the_table_of_what_was_done(tmp_path: Path):
    rows: list[Any] = []

    def ended(row: Any) -> None:
        rows.append(row)
        if len(rows) == 2:
            raise KeyError("no such bug")

    with pytest.raises(KeyError):
        run_sweep(plan(Axis.parse(f"{LENGTH}=0.5:1:3")), tmp_path, ended=ended)
    assert (tmp_path / "sweep.csv").read_text().count("\n") == 3


def test_parquet_is_the_table(tmp_path: Path):
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = run_sweep(plan(Axis.parse(f"{LENGTH}=0.5:1:3"), MASSES), tmp_path)
    table = parquet.read_table(tmp_path / "sweep.parquet")
    assert table.column_names == module.columns(rows)
    for row, written in zip(rows, table.to_pylist(), strict=True):
        assert {key: value for key, value in written.items() if value is not None} == row.cells()
    assert json.loads(table.schema.metadata[b"dynsim"])["plan"]["runs"] == 9


def test_resuming_runs_what_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    swept = plan(Axis.parse(f"{LENGTH}=0.5:1:5"))
    whole = run_sweep(swept, tmp_path)
    table, journal = (tmp_path / "sweep.csv").read_bytes(), tmp_path / JOURNAL
    with raises(ScenarioError, "--resume", "--out"):
        run_sweep(swept, tmp_path)
    # As a process leaves it that is killed while it writes the third line; the second run was lost.
    lines = journal.read_text().splitlines(keepends=True)
    lost = json.dumps(json.loads(lines[1]) | {"status": LOST}) + "\n"
    journal.write_text(lines[0] + lost + lines[2][:40])
    ran: list[int] = []

    class Watched(module.BatchWork):
        def __call__(self, point: Any, look: Any) -> Any:
            ran.append(point.run)
            return super().__call__(point, look)

    monkeypatch.setattr(module, "BatchWork", Watched)
    assert run_sweep(swept, tmp_path, resume=True) == whole
    assert ran == [1, 2, 3, 4]
    assert (tmp_path / "sweep.csv").read_bytes() == table
    # A finer grid keeps what it shares with the coarse one.
    ran.clear()
    finer = run_sweep(plan(Axis.parse(f"{LENGTH}=0.5:1:9")), tmp_path, resume=True)
    assert ran == [1, 3, 5, 7]
    assert [row.numbers for row in finer[::2]] == [row.numbers for row in whole]


def test_another_scenario_is_not_gone_on_with(tmp_path: Path):
    axis = Axis.parse(f"{LENGTH}=0.5,1")
    run_sweep(plan(axis), tmp_path)
    with raises(ScenarioError, "overrides", "--out"):
        run_sweep(Plan(PENDULUM, (None,), {"duration_s": 0.1}, (axis,)), tmp_path, resume=True)


def test_a_misspelt_key_is_refused_before_the_first_run(tmp_path: Path):
    with pytest.raises(ScenarioError, match="lenght_m"):
        run_sweep(plan(Axis.parse("plant.chain.0.lenght_m=1,2")), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("keep", "kept"), [("none", []), ("failed", []), ("all", ["000000", "000002"])])
def test_records_are_kept_as_asked(tmp_path: Path, keep: Any, kept: list[str]):
    run_sweep(plan(MASSES), tmp_path, keep_records=keep)
    folder = tmp_path / "records"
    assert sorted(path.name for path in folder.glob("*")) == kept
    assert all(Record.load(folder / name / "record.h5").complete for name in kept)


ROWS: list[dict[str, Any]] = [
    {"variant": variant, "a": a, "b": b, "mass": mass}
    | {"electrical_energy_J": 9.0 + a + mass, "hand_error_rms_m": 1e-3 * mass}
    for variant in ("one", "two")
    for a in (0.0, 1.0)
    for b in ("x", "y")
    for mass in (1.0, 2.0, 4.0)
]


@pytest.mark.parametrize(
    ("grid", "sampled", "files"),
    [
        (["a"], [], {"sweep_lines", "sweep_pareto"}),
        (["b"], ["mass"], {"sweep_lines", "sweep_pareto", "sweep_samples", "sweep_tornado"}),
        (["a", "b"], ["mass"], {"sweep_map", "sweep_pareto", "sweep_samples", "sweep_tornado"}),
        ([], ["mass"], {"sweep_pareto", "sweep_samples", "sweep_tornado"}),
    ],
)
def test_figures_by_what_was_varied(tmp_path: Path, grid: list[str], sampled: list[str], files: set[str]):
    drawn = pictures.draw(pictures.Sweep("test", ROWS, grid, sampled), tmp_path)
    assert {path.stem for path in drawn} == {path.stem for path in tmp_path.glob("*.png")} == files
    captions = (tmp_path / "captions.txt").read_text("utf-8").split("\n\n")
    assert {caption.partition("\n")[0] for caption in captions} == files


@pytest.mark.parametrize(
    ("key", "label"),
    [
        ("base.tip_margin_min", "tip margin, whole run"),
        ("elbow_4.normal_force_max_N", "elbow_4: normal force, max [N]"),
        ("joint_1.torque_rms_N_m", "joint_1: torque, rms [N m]"),
        ("position_error_max_m", "position error, max [m]"),
        ("slip_max_m_per_s", "slip, max [m/s]"),
    ],
)
def test_any_number_is_drawn_with_its_unit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, key: str, label: str):
    monkeypatch.setattr(style, "save", lambda figure, path: path)  # what is drawn counts, not the pictures
    rows = [{**row, key: row["mass"] - 2.0} for row in ROWS]
    table = pictures.Sweep("test", rows, ["a"], ["mass"], plotted=[key, "hand_error_rms_m", "not_there"])
    assert [drawn.label for drawn in table.metrics.values()] == [label, "hand error, rms [mm]"]
    assert {path.stem for path in pictures.draw(table, tmp_path)} == {"sweep_lines", "sweep_samples", "sweep_tornado"}
    first, second = (axes.get_ylabel().replace("\n", " ") for axes in pictures.lines(table).axes)
    assert (first, second[-4:]) == (label, "[mm]")


def test_the_tornado_shows_the_effect_of_a_deviation():
    figure = pictures.tornado(pictures.Sweep("test", ROWS, ["a", "b"], ["mass"]))
    assert figure is not None
    # The draws are three, at each of four places of the grid; each panel shows both variants.
    deviation = np.array([1.0, 2.0, 4.0]).std(ddof=1)
    widths = [bar.get_width() for axes in figure.axes for bar in axes.patches]
    assert widths == pytest.approx([deviation] * 4)


def noisy(places: int, draws: int) -> pictures.Sweep:
    """A sweep whose places differ more than its draws."""
    generator = np.random.default_rng(5)
    drawn = [(mass, generator.normal()) for mass in generator.normal(size=draws)]
    rows = [
        {
            "plant.a": float(a),
            "m": m,
            "electrical_energy_J": 100.0 * (a + 1) + m + 0.1 * damping,
            "hand_error_rms_m": 1e-3 * damping,
        }
        for a in range(places)
        for m, damping in drawn
    ]
    return pictures.Sweep("test", rows, ["plant.a"], ["m"])


def test_more_places_of_the_grid_are_no_more_draws():
    few, many = (pictures.tornado(noisy(places, draws=12)) for places in (1, 50))
    assert few is not None
    assert many is not None
    assert few.caption == many.caption
    for axis, other in zip(few.axes, many.axes, strict=True):
        bars = [axes.collections[0].get_segments()[0] for axes in (axis, other)]
        np.testing.assert_allclose(bars[0], bars[1], rtol=1e-9)


def energy_panels(figure: Figure) -> list[Axes]:
    """Panels with energies, which are larger than errors [mm]."""
    return [axes for axes in figure.axes if axes.lines and axes.lines[0].get_xdata()[0] > 50.0]


def test_distributions_are_those_of_one_place():
    sweep = noisy(places=3, draws=20)
    figure = pictures.samples(sweep)
    assert figure is not None
    energies = energy_panels(figure)
    assert [axes.get_title().split("\n")[0] for axes in energies] == ["plant.a = 0", "plant.a = 1", "plant.a = 2"]
    for index, axes in enumerate(energies):
        here = spread(np.array([row["electrical_energy_J"] for row in sweep.rows if row["plant.a"] == index]))
        assert axes.lines[0].get_xdata()[0] == pytest.approx(here.mean)
        assert mentions(axes.get_title(), f"{here.mean:.2f} ± {here.mean - here.mean_low:.2f}")
        assert sum(bar.get_height() for bar in axes.patches) == 20


def test_of_many_places_some_are_shown_with_a_note():
    figure = pictures.samples(noisy(places=50, draws=3))
    assert figure is not None
    heads = [axes.get_title().split("\n")[0] for axes in energy_panels(figure)]
    assert heads == [f"plant.a = {k}" for k in (0, 12, 24, 37, 49)]
    assert mentions(figure.caption, "5", "50", "statistics.json")


def test_the_colour_of_a_variant_does_not_depend_on_which_were_run():
    every = ["one", "two"]
    table = pictures.Sweep("test", [row for row in ROWS if row["variant"] == "two"], [], ["mass"], every)
    assert table.looks["two"] == pictures.Sweep("test", ROWS, [], ["mass"], every).looks["two"]
    figure = pictures.samples(table)
    assert figure is not None
    assert figure.axes[0].patches[0].get_facecolor()[:3] == to_rgb(style.VARIANT_COLOURS[1])


def test_runs_at_the_same_place_do_not_hide_each_other():
    figure = pictures.pareto(pictures.Sweep("test", ROWS, ["a", "b"], ["mass"]))
    assert figure is not None
    everything, best = figure.axes[0].collections[::2], figure.axes[0].collections[1::2]
    assert [len(dots.get_offsets()) for dots in everything] == [12, 12]
    assert not any(len(dots.get_facecolors()) for dots in everything)
    # Only the runs on the front are filled: those with the least mass at the first value of a.
    assert [len(dots.get_offsets()) for dots in best] == [2, 2]
    assert all(len(dots.get_facecolors()) for dots in best)


def test_variants_differ_in_their_markers_and_the_best_runs_are_described():
    rows = [row | {"run": k} for k, row in enumerate(ROWS)]
    figure = pictures.pareto(pictures.Sweep("test", rows, ["a", "b"], ["mass"]))
    assert figure is not None
    axes = figure.axes[0]
    first, second = (dots.get_paths()[0].vertices for dots in axes.collections[::2])
    assert first.shape != second.shape
    # The lightest of the first place, of either variant, is the least in both; it needs no number.
    assert not axes.texts
    run = rows[0]
    assert mentions(
        figure.caption, f"Best run ({run['variant']}, a\u00a0=\u00a0{run['a']:g}, b\u00a0=\u00a0{run['b']})"
    )
    # A run with less energy and a larger error is on the front as well.
    other = rows[-1] | {"electrical_energy_J": 0.5 * run["electrical_energy_J"], "run": 99}
    figure = pictures.pareto(pictures.Sweep("test", [*rows, other], ["a", "b"], ["mass"]))
    assert figure is not None
    assert {text.get_text() for text in figure.axes[0].texts} == {"0", "99"}
    assert mentions(figure.caption, f"99: {other['variant']}, a\u00a0=\u00a0{other['a']:g}")


@pytest.mark.parametrize(("status", "text"), [("ok", "number does not exist"), ("failed", "no run succeeded")])
def test_cells_without_numbers_are_explained(status: str, text: str):
    rows = [row if row["a"] or row["b"] == "x" else dict(list(row.items())[:4]) | {"status": status} for row in ROWS]
    figures = [pictures.heat_map(pictures.Sweep("test", table, ["a", "b"], ["mass"])) for table in (rows, ROWS)]
    texts = [[label.get_text() for legend in figure.legends for label in legend.get_texts()] for figure in figures]
    assert texts == [[text], []]


def test_variant_without_the_number_has_no_map():
    """A free arm has no force of a brace: its runs did not fail."""
    rows = [row | ({"elbow.normal_force_mean_N": 1.0 + row["a"]} if row["variant"] == "one" else {}) for row in ROWS]
    sweep = pictures.Sweep("test", rows, ["a", "b"], ["mass"], plotted=["elbow.normal_force_mean_N"])
    figure = pictures.heat_map(sweep)
    assert figure is not None
    assert [axes.get_title() for axes in figure.axes] == ["one", ""]
    assert [text.get_text() for text in figure.axes[0].texts] == ["1.000", "2.000", "1.000", "2.000"]
    assert not figure.legends
    assert mentions(figure.caption, "elbow: normal force, mean", "two")


def test_axes_of_varied_keys_are_in_words_with_units():
    rows = [row | {"a": 0.01 + 0.02 * row["a"]} for row in ROWS]
    keys = {"a": Quantity("height of table", unit="m"), "b": Quantity("coefficient of friction", "μ")}
    sweep = pictures.Sweep("test", rows, ["a", "b"], ["mass"], keys=keys)
    figure = pictures.heat_map(sweep)
    assert figure is not None
    below = figure.axes[2]
    assert below.get_xlabel() == "height of table [mm]"
    assert below.get_ylabel().replace("\n", " ") == "coefficient of friction μ"
    assert [text.get_text() for text in below.get_xticklabels()] == ["10", "30"]
    assert sweep.value("a", 0.03) == "height of table = 30 mm"
    assert sweep.value("b", "x") == "μ = x"


def test_single_value_far_beyond_the_others_is_beyond_the_axis():
    rows = [row | {"tip": -1e12 if k == 0 else float(k)} for k, row in enumerate(ROWS)]
    figure = pictures.lines(pictures.Sweep("test", rows, ["a"], [], plotted=["tip"]))
    assert figure is not None
    assert figure.axes[0].get_ylim()[0] > -10.0
    assert min(np.nanmin(line.get_ydata()) for line in figure.axes[0].lines) > -10.0
    assert mentions(figure.caption, "1 of 24", "−10¹²")


def test_result_does_not_replace_a_varied_value_of_the_same_name():
    """Failed runs have only the varied value: 1 and 1.0 would be two rows of a map."""
    plan = Plan(PENDULUM, (None,), {}, (Axis.parse("duration_s=1,2"),), (), 1, 0)
    rows = [SweepRow(0, None, {"duration_s": 1}, "ok", "", {"duration_s": 1.0, "steps": 9}, "")]
    (drawn,) = drawn_table("single_pendulum", rows, plan).rows
    assert (str(drawn["duration_s"]), drawn["steps"]) == ("1", 9)


def test_ticks_of_maps_do_not_touch_each_other():
    rows = [row | {"a": -0.12 + 0.01 * k} for k in range(7) for row in ROWS]
    figure = pictures.heat_map(pictures.Sweep("test", rows, ["a", "b"], ["mass"]))
    assert figure is not None
    texts = [text.get_text() for text in figure.axes[2].get_xticklabels()]
    assert texts[0] == "−0.12"
    assert len({len(text) for text in texts}) == 1
    boxes = [text.get_window_extent() for text in figure.axes[2].get_xticklabels()]
    assert all(left.x1 + 2.0 < right.x0 for left, right in itertools.pairwise(boxes))


def test_markers_of_lines_are_not_cut_by_the_frame():
    figure = pictures.lines(pictures.Sweep("test", ROWS, ["a"], ["mass"]))
    assert figure is not None
    for axes in figure.axes:
        assert axes.get_xlim()[0] < 0.0
        assert axes.get_xlim()[1] > 1.0
        assert not any(line.get_clip_on() for line in axes.lines)


def test_lines_mark_failures_on_the_axis_and_omit_values_without_success():
    at = float(ROWS[0]["a"])
    rows = [row for row in ROWS if row["variant"] != "one" or row["a"] != at]
    rows += [{"variant": "one", "a": value, "b": "x", "mass": 1.0, "status": "failed"} for value in (at, 5.0)]
    rows.append({"variant": "two", "a": 5.0, "b": "x", "mass": 1.0, "status": "failed"})
    figure = pictures.lines(pictures.Sweep("test", rows, ["a"], []))
    assert figure is not None
    for axes in figure.axes:
        (crosses,) = (line for line in axes.lines if line.get_marker() == "x")
        assert list(crosses.get_xdata()) == [at]
        assert axes.get_xlim()[1] < 5.0
    assert mentions(figure.caption, f"No run succeeded: one at {at:g}, 5; two at 5.")


def test_words_are_rows_of_the_lines():
    figure = pictures.lines(pictures.Sweep("test", ROWS, ["b"], []))
    assert figure is not None
    labels = [[label.get_text() for label in axes.get_yticklabels()] for axes in figure.axes]
    assert labels[0] == [f"b {word}" for word in dict.fromkeys(row["b"] for row in ROWS)]
    means = {line.get_label(): line.get_xdata() for line in figure.axes[0].lines}
    first = [row["electrical_energy_J"] for row in ROWS if row["variant"] == "one" and row["b"] == ROWS[0]["b"]]
    assert means["one"][0] == pytest.approx(np.mean(first))


@pytest.mark.parametrize(
    ("text", "shown"), [("3.632e-11", "3.632 × 10⁻¹¹"), ("1.2e+12", "1.2 × 10¹²"), ("-0.5", "−0.5")]
)
def test_exponents_are_powers_of_ten(text: str, shown: str):
    assert style.with_powers(text) == shown


def test_colour_bars_stand_below_their_column():
    figure = pictures.heat_map(pictures.Sweep("test", ROWS, ["a", "b"], ["mass"]))
    assert figure is not None
    figure.draw_without_rendering()
    for column, bar in zip(figure.axes[:2], figure.axes[4:], strict=True):
        above, below = column.get_position(), bar.get_position()
        assert below.y1 < above.y0
        assert (below.x0, below.x1) == pytest.approx((above.x0, above.x1), abs=1e-6)


# One run takes long enough to be met on its way.
LONG = ["--set", "duration_s=3000", "--set", "record.rate_hz=1", "--no-figures", "--jobs", "2"]
GRID = ["single_pendulum", "--grid", f"{LENGTH}=0.5:1:12"]


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "dynsim", "sweep", *GRID, *LONG, *arguments]


def done(folder: Path) -> int:
    journal = folder / JOURNAL
    return journal.read_text().count("\n") if journal.exists() else 0


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The table of a sweep that nothing ends."""
    folder = tmp_path_factory.mktemp("whole")
    subprocess.run(command("--out", str(folder), "-q"), check=True, timeout=300)
    return (folder / "sweep.csv").read_bytes()


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL], ids=lambda number: number.name)
def test_whatever_ends_a_sweep_it_goes_on(tmp_path: Path, number: signal.Signals, whole: bytes):
    out = tmp_path / "out"
    with started(command("--out", str(out), "-q"), tmp_path / "errors", preexec_fn=_hears) as child:
        wait_for(lambda: done(out) >= 2)
        child.process.send_signal(number)
        code = child.end()
    kept = done(out)
    assert 2 <= kept < 12
    assert code == (130 if number == signal.SIGINT else -number)
    if number == signal.SIGINT:
        assert mentions(child.stderr, str(kept), "12", "--resume")
        assert (out / "sweep.csv").read_text().count("\n") == kept + 1
    subprocess.run(command("--out", str(out), "--resume", "-q"), check=True, timeout=300)
    assert done(out) == 12
    assert (out / "sweep.csv").read_bytes() == whole


@pytest.mark.long
def test_a_killed_worker_costs_nothing_but_time(tmp_path: Path, whole: bytes):
    out = tmp_path / "out"
    with started(command("--out", str(out), "-q"), tmp_path / "errors") as child:
        wait_for(lambda: done(out) >= 2 and bool(workers_of(child.process.pid)))
        os.kill(workers_of(child.process.pid)[0], signal.SIGKILL)
        assert child.end() == 0, child.stderr
    assert (out / "sweep.csv").read_bytes() == whole


@pytest.mark.slow
def test_a_sweep_of_5000_runs_outlives_a_killed_worker_every_two_seconds(tmp_path: Path, whole: bytes):
    """Any worker can be killed, also while it starts; the kernels are compiled already (``whole``)."""
    out, rng, killed = tmp_path / "out", np.random.default_rng(49), 0
    runs = [
        "single_pendulum",
        "--set",
        "duration_s=60",
        "--grid",
        f"{LENGTH}=0.5:1:5000",
        "--no-figures",
        "--jobs",
        "2",
    ]
    with started(
        [sys.executable, "-m", "dynsim", "sweep", *runs, "--out", str(out), "-q"], tmp_path / "errors"
    ) as child:
        while child.process.poll() is None:
            time.sleep(2.0)
            if workers := workers_of(child.process.pid):
                os.kill(int(rng.choice(workers)), signal.SIGKILL)
                killed += 1
        code = child.end()
    with (out / "sweep.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    lost = sum(row["status"] == LOST for row in rows)
    print(f"{killed} workers killed; exit code {code}; {len(rows)} rows, {lost} of them lost")
    assert len(rows) == done(out) == 5000, child.stderr
    assert code == (0 if lost == 0 else 3), child.stderr
    assert killed > 10
    assert lost < 0.01 * len(rows)


def workers_of(pid: int) -> list[int]:
    """Worker processes of a parent, the one that has done most first: others may be loading still."""

    def ticks(child: int) -> int:
        return sum(map(int, Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[11:13]))

    children = map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split())
    workers = [child for child in children if "dynsim.studies.processes" in Path(f"/proc/{child}/cmdline").read_text()]
    return sorted(workers, key=ticks, reverse=True)


def _hears() -> None:
    """Where tests run in the background, SIGINT is ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.long
def test_a_cluster_gives_the_same_and_outlives_a_worker(tmp_path: Path, whole: bytes):
    pytest.importorskip("distributed")
    file, out = tmp_path / "scheduler.json", tmp_path / "out"
    dask = [sys.executable, "-m"]
    scheduler = [*dask, "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    worker = [*dask, "distributed.cli.dask_worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-dashboard"]
    worker += ["--no-nanny", "--local-directory", str(tmp_path / "scratch")]
    with started([*scheduler, "--scheduler-file", str(file)], tmp_path / "scheduler") as first:
        wait_for(lambda: file.exists() and file.stat().st_size > 0)
        address = json.loads(file.read_text())["address"]
        with started(worker, tmp_path / "w1") as worker_1, started(worker, tmp_path / "w2"):
            first.wait_for("Register worker", 2)
            arguments = ["sweep", *GRID, *LONG[:-2], "--out", str(out), "--scheduler", address]
            with started([*dask, "dynsim", *arguments], tmp_path / "errors") as child:
                wait_for(lambda: done(out) >= 2)
                worker_1.process.kill()
                assert child.end() == 0, child.stderr
    assert (out / "sweep.csv").read_bytes() == whole


@pytest.mark.long
def test_a_scheduler_that_dies_is_one_line(tmp_path: Path):
    pytest.importorskip("distributed")
    file, out = tmp_path / "scheduler.json", tmp_path / "out"
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    with started([*dask, "--no-dashboard", "--scheduler-file", str(file)], tmp_path / "scheduler") as scheduler:
        wait_for(lambda: file.exists() and file.stat().st_size > 0)
        address = json.loads(file.read_text())["address"]
        arguments = ["sweep", *GRID, *LONG[:-2], "--out", str(out), "--scheduler", address]
        with started([sys.executable, "-m", "dynsim", *arguments], tmp_path / "errors") as child:
            wait_for((out / JOURNAL).exists)
            scheduler.wait_for("Starting established connection")
            scheduler.process.kill()
            assert child.end() == 2, child.stderr
    said = " ".join(child.stderr.split())
    assert said.startswith("error: ")
    assert mentions(said, address, "--resume")
    assert "Traceback" not in said


@pytest.mark.parametrize("address", ["nowhere", "nonsense://host:1"])
def test_what_is_no_address_is_one_line(tmp_path: Path, address: str):
    pytest.importorskip("distributed")
    arguments = ["sweep", *GRID, *LONG[:-2], "--out", str(tmp_path / "out"), "--scheduler", address]
    ended = subprocess.run([sys.executable, "-m", "dynsim", *arguments], capture_output=True, text=True, timeout=120)
    assert ended.returncode == 2
    assert mentions(ended.stderr, address)
    assert "Traceback" not in ended.stderr


def test_runs_that_failed_are_counted_and_not_drawn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A base that tips after 5 s has taken a tenth of the energy; next to whole runs it looked like the best of all."""
    numbers = {ENERGY: 1.0, "hand_error_rms_m": 0.1}
    status = ["ok", "failed", "ok"]
    rows = [SweepRow(k, None, {"duration_s": k + 1}, state, "", numbers, "") for k, state in enumerate(status)]
    seen: list[pictures.Sweep] = []
    monkeypatch.setattr(pictures, "draw", lambda sweep, *_: seen.append(sweep))
    sweep_command._draw("tipping", rows, plan(Axis("duration_s", (1, 2, 3))), tmp_path, True, "png", Look())
    (table,) = seen
    assert [row["duration_s"] for row in table.rows] == [1, 2, 3]
    assert [bool(numbers.keys() & row.keys()) for row in table.rows] == [True, False, True]
    assert table.figure(1.0, "all").notes == "1 of 3 runs failed."
    assert replace(table, rows=[table.rows[0], table.rows[2]]).figure(1.0, "all").notes == ""
    # The place stays, without a point.
    drawn = pictures.lines(table)
    assert drawn is not None
    (line,) = drawn.axes[0].get_lines()
    assert np.isfinite(np.asarray(line.get_ydata(), dtype=float)).tolist() == [True, False, True]
