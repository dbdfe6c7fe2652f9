"""Damaged sweep folders: one error that names the file and the fix, and nothing lost."""

import csv
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from support.messages import mentions, raises

from dynsim.errors import DynsimError, RecordError
from dynsim.scenario import read_scenario
from dynsim.studies import sweep as sweep_module
from dynsim.studies.sweep import JOURNAL, PLAN, SweepJournal, SweepRow, run_sweep
from dynsim.studies.sweep_plan import Axis, Plan
from dynsim.system.files import held_folder

SHORT = {"duration_s": 0.01, "metrics.settle_s": 0.0}
SWEPT = Plan(read_scenario("single_pendulum"), (None,), SHORT, (Axis.parse("plant.chain.0.mass_kg=1,2,3,4"),))


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sound")
    run_sweep(SWEPT, folder)
    return folder


@pytest.fixture
def folder(sound: Path, tmp_path: Path) -> Path:
    """A sweep that is done."""
    return Path(shutil.copytree(sound, tmp_path / "swept"))


def written(name: str, content: bytes) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes(content) and None


def cut(name: str, share: float) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: int(share * len(content))])

    return damage


def without(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def as_folder(name: str) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        (folder / name).mkdir()

    return damage


def as_pipe(name: str) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        (folder / name).unlink()
        os.mkfifo(folder / name)

    return damage


def header(**changes: Any) -> Callable[[Path], None]:
    """Other values of keys of the plan; ... for a key that is not there."""

    def damage(folder: Path) -> None:
        data = json.loads((folder / PLAN).read_text()) | changes
        (folder / PLAN).write_text(json.dumps({key: value for key, value in data.items() if value is not ...}))

    return damage


def row(**changes: Any) -> Callable[[Path], None]:
    """Other values of keys of the second row; ... for a key that is not there."""

    def damage(folder: Path) -> None:
        lines = (folder / JOURNAL).read_text().splitlines()
        data = json.loads(lines[1]) | changes
        lines[1] = json.dumps({key: value for key, value in data.items() if value is not ...})
        (folder / JOURNAL).write_text("\n".join([*lines, ""]))

    return damage


def line(content: bytes) -> Callable[[Path], None]:
    """Something else in the second line."""

    def damage(folder: Path) -> None:
        lines = (folder / JOURNAL).read_bytes().splitlines()
        lines[1] = content
        (folder / JOURNAL).write_bytes(b"\n".join([*lines, b""]))

    return damage


# Damage, the file that is named, and a word of what is wrong with it.
SECOND = f"{JOURNAL} 2"
DAMAGES: list[tuple[str, Callable[[Path], None], str, str]] = [
    ("plan cut", cut(PLAN, 0.5), PLAN, ""),
    ("plan empty", written(PLAN, b""), PLAN, ""),
    ("plan zeros", written(PLAN, bytes(500)), PLAN, ""),
    ("plan not text", written(PLAN, b"\xff\xfe\x00{"), PLAN, ""),
    ("plan deep", written(PLAN, b"[" * 200_000), PLAN, ""),
    ("plan a list", written(PLAN, b"[1, 2]"), PLAN, "scenario, overrides, dynsim_version, commit"),
    ("plan null", written(PLAN, b"null"), PLAN, "scenario, overrides, dynsim_version, commit"),
    ("plan of something else", written(PLAN, b'{"name": "mine"}'), PLAN, "scenario, overrides, dynsim_version, commit"),
    ("plan without scenario", header(scenario=...), PLAN, "scenario, overrides, dynsim_version, commit"),
    ("plan's scenario a number", header(scenario=3), PLAN, "scenario = 3"),
    ("plan's overrides a list", header(overrides=[]), PLAN, "overrides = []"),
    ("plan's version a number", header(dynsim_version=0.1), PLAN, "dynsim_version = 0.1"),
    ("plan missing", without(PLAN), PLAN, ""),
    ("plan a folder", as_folder(PLAN), PLAN, ""),
    ("plan a pipe", as_pipe(PLAN), PLAN, ""),
    ("journal missing", without(JOURNAL), JOURNAL, ""),
    ("journal a folder", as_folder(JOURNAL), JOURNAL, ""),
    ("journal a pipe", as_pipe(JOURNAL), JOURNAL, ""),
    ("line empty", line(b""), SECOND, ""),
    ("line cut", line(b'{"run": 1, "vari'), SECOND, ""),
    ("line not text", line(b"\xff\xff"), SECOND, ""),
    ("line zeros", line(bytes(80)), SECOND, ""),
    ("line deep", line(b"[" * 200_000), SECOND, ""),
    ("line a number", line(b"7"), SECOND, "run, variant, values, status, reason, numbers, warnings"),
    ("line a long number", line(b"7" * 5000), SECOND, ""),
    ("row without run", row(run=...), SECOND, "run, variant, values, status, reason, numbers, warnings"),
    ("row with more", row(more=1), SECOND, "run, variant, values, status, reason, numbers, warnings"),
    ("row's run a text", row(run="1"), SECOND, "run = '1'"),
    ("row's run below 0", row(run=-1), SECOND, "run = -1"),
    ("row's run a truth", row(run=True), SECOND, "run = True"),
    ("row's variant a number", row(variant=1), SECOND, "variant = 1"),
    ("row's values a list", row(values=[1.0]), SECOND, "values = [1.0]"),
    ("row's status another", row(status="fine"), SECOND, "status = 'fine'"),
    ("row's status a list", row(status=["ok"]), SECOND, "status = ['ok']"),
    ("row's reason a number", row(reason=0), SECOND, "reason = 0"),
    ("row's numbers nothing", row(numbers=None), SECOND, "numbers = None"),
    ("row's number endless", row(numbers={"duration_s": float("inf")}), SECOND, "numbers = {'duration_s': inf}"),
    ("row's number none", row(numbers={"duration_s": float("nan")}), SECOND, "numbers = {'duration_s': nan}"),
    ("row's numbers texts", row(numbers={"energy": "much"}), SECOND, "numbers = {"),
    ("row's numbers too large", row(numbers={"energy": 10**400}), SECOND, "numbers = {"),
    ("row's warnings a list", row(warnings=[]), SECOND, "warnings = []"),
    ("table a folder", as_folder("sweep.csv"), "sweep.csv", ""),
    ("other table a folder", as_folder("sweep.parquet"), "sweep.parquet", ""),
    ("statistics a folder", as_folder("statistics.json"), "statistics.json", ""),
]


@pytest.mark.parametrize(
    ("damage", "file", "said"), [damage[1:] for damage in DAMAGES], ids=[damage[0] for damage in DAMAGES]
)
def test_a_damaged_folder_is_one_error(folder: Path, damage: Callable[[Path], None], file: str, said: str):
    damage(folder)
    before = contents(folder)
    with pytest.raises(DynsimError) as caught:
        run_sweep(SWEPT, folder, resume=True)
    message = str(caught.value)
    assert mentions(message, *file.split())
    assert said in message
    assert "; " in message  # what to do
    assert contents(folder) == before


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() if path.is_file() else b"" for path in sorted(folder.iterdir())}


@pytest.mark.parametrize(
    "damage",
    [
        written("sweep.csv", b"\x00\xff, garbled"),
        cut("sweep.csv", 0.5),
        without("sweep.csv"),
        written("sweep.parquet", b"no table"),
        written("somebody.txt", b"else's"),
        cut(JOURNAL, 0.9),
        row(values={"plant.chain.0.mass_kg": "much"}),
    ],
    ids=["table garbled", "table cut", "no table", "no parquet", "a foreign file", "last line cut", "a foreign row"],
)
def test_what_can_be_made_again_is(folder: Path, sound: Path, damage: Callable[[Path], None]):
    damage(folder)
    run_sweep(SWEPT, folder, resume=True)
    assert (folder / "sweep.csv").read_bytes() == (sound / "sweep.csv").read_bytes()


def test_a_file_in_place_of_the_folder_is_one_error(tmp_path: Path):
    (tmp_path / "swept").touch()
    with raises(RecordError, "swept"):
        run_sweep(SWEPT, tmp_path / "swept")


def test_a_file_in_place_of_the_records_is_said_before_the_first_run(tmp_path: Path):
    (tmp_path / "records").touch()
    with raises(RecordError, "records"):
        run_sweep(SWEPT, tmp_path, keep_records="all")
    assert not (tmp_path / JOURNAL).exists()


def test_a_first_value_that_is_left_and_makes_no_scenario_is_a_row(tmp_path: Path):
    """The sweep was begun with a good one."""
    swept = Plan(SWEPT.file, (None,), SHORT, (Axis("plant.chain.0.mass_kg", (1.0, -1.0)),))
    run_sweep(swept, tmp_path)
    cut(JOURNAL, 0.9)(tmp_path)
    assert [row.status for row in run_sweep(swept, tmp_path, resume=True)] == ["ok", "failed"]


@pytest.mark.skipif(sys.platform == "win32", reason="no locks there")
@pytest.mark.parametrize("resume", [False, True])
def test_a_folder_is_one_process_at_a_time(folder: Path, resume: bool):
    before = contents(folder)
    with held_folder(folder), raises(RecordError, str(folder), "--out"):
        run_sweep(SWEPT, folder, resume=resume)
    assert contents(folder) == before
    # And afterwards it is free.
    run_sweep(SWEPT, folder, resume=True)


def test_a_dead_process_holds_nothing(folder: Path):
    code = "import os, sys; from pathlib import Path; from dynsim.system.files import held_folder\n"
    code += "with held_folder(Path(sys.argv[1])): os.kill(os.getpid(), 9)"
    subprocess.run([sys.executable, "-c", code, str(folder)], check=False, timeout=120)
    run_sweep(SWEPT, folder, resume=True)


LIMITED = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv.pop(1)), resource.RLIM_INFINITY))
from dynsim.cli import main
main()
"""
ARGUMENTS = ["sweep", "single_pendulum", "--grid", "plant.chain.0.mass_kg=1:4:12", "--no-figures", "--out", "out"]
ARGUMENTS += ["--set", "duration_s=0.01", "--set", "metrics.settle_s=0"]


@pytest.mark.skipif(sys.platform == "win32", reason="no limits there")
@pytest.mark.parametrize("jobs", ["1", pytest.param("2", marks=pytest.mark.slow)])
def test_a_file_that_may_not_grow_is_named_and_no_run_is_lost(tmp_path: Path, jobs: str):
    """Room for some runs, as on a disk that fills up."""
    command = [sys.executable, "-c", LIMITED, "6000", *ARGUMENTS, "--jobs", jobs]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 2, ended.stderr
    said = " ".join(ended.stderr.split())
    assert said.startswith("error: ")
    assert mentions(said, "out/runs.jsonl", "File too large", "--resume")
    assert "Traceback" not in said
    kept = (tmp_path / "out" / JOURNAL).read_text().count("\n")
    assert 0 < kept < 12
    command = [sys.executable, "-m", "dynsim", *ARGUMENTS, "--resume", "--jobs", jobs]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0, ended.stderr
    with (tmp_path / "out" / "sweep.csv").open() as table:
        assert [row["status"] for row in csv.DictReader(table)] == ["ok"] * 12


@pytest.mark.parametrize("file", ["sweep.json", "sweep.csv", "records/000001/record.h5"])
def test_a_full_disk_names_its_file(tmp_path: Path, file: str, monkeypatch: pytest.MonkeyPatch):
    """A run whose record has no room has no row, so that it is run again."""

    def full(path: Path) -> None:
        if str(path).endswith(file):
            raise RecordError(f"cannot write {path}: No space left on device; nothing was changed there")

    write_text, save_run = sweep_module.write_text, sweep_module.save_run
    monkeypatch.setattr(sweep_module, "write_text", lambda path, text: (full(path), write_text(path, text)))
    monkeypatch.setattr(
        sweep_module, "save_run", lambda record, folder: (full(folder / "record.h5"), save_run(record, folder))
    )
    with raises(RecordError, file, "No space left on device", "--resume"):
        run_sweep(SWEPT, tmp_path, keep_records="all")
    monkeypatch.undo()
    rows = run_sweep(SWEPT, tmp_path, keep_records="all", resume=True)
    assert [row.status for row in rows] == ["ok"] * 4
    assert len(list(tmp_path.glob("records/*/record.h5"))) == 4


def test_the_journal_names_itself(tmp_path: Path):
    """/dev/full takes nothing."""
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    row = SweepRow(0, None, {}, "ok", "", {}, "")
    with closing(SweepJournal(tmp_path, [])) as journal:
        journal._stream.close()
        (tmp_path / JOURNAL).unlink()
        (tmp_path / JOURNAL).symlink_to("/dev/full")
        journal._stream = (tmp_path / JOURNAL).open("ab", buffering=0)
        with raises(RecordError, "runs.jsonl", "No space left on device"):
            journal.add(row)
