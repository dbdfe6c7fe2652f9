"""Worker processes: started from any script, killed, or unable to start; errors and isolation of their tasks."""

import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from support.messages import check_message, mentions, raises
from support.processes import wait_for
from support.sweep_work import REFUSED, busy, pid, says, square, unsendable

from dynsim.record import isolated
from dynsim.studies import processes
from dynsim.studies.processes import START, STARTS, WorkerError, end_workers, run_in_processes

BATCH = """
import json, os, sys
import dynsim

before = dict(os.environ), list(sys.path), sys.modules["__main__"]
pendulums = [dynsim.load_scenario("single_pendulum", overrides={"duration_s": 0.1 * k}) for k in (2, 3)]
runs = dynsim.simulate_batch(pendulums, jobs=2)
variants = dynsim.compare("elbow_comparison", overrides={"duration_s": 0.05}, jobs=2)
assert before == (dict(os.environ), list(sys.path), sys.modules["__main__"])
print(json.dumps([[run.reason or run.summary["duration_s"] for run in runs], list(variants)]))
"""
# Of a batch, whatever starts it.
DONE = [[0.2, 0.3], ["two_elbows", "elbow_7", "elbow_4", "no_elbow"]]


@pytest.mark.long
@pytest.mark.parametrize("from_file", [True, False], ids=["a file", "standard input"])
def test_a_script_needs_no_guard(tmp_path: Path, from_file: bool):
    """Once: workers run nothing of it."""
    (tmp_path / "script.py").write_text(BATCH)
    with (tmp_path / "script.py").open() as script:
        ended = subprocess.run(
            [sys.executable, "script.py" if from_file else "-"],
            cwd=tmp_path, stdin=script, capture_output=True, text=True, timeout=300,
        )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout) == DONE
    assert ended.stderr == ""


# What has loaded dynsim before the folder is searched, as notebooks do.
NOTEBOOK = """
import sys
import dynsim.studies.batch
sys.path.insert(0, "")
exec(sys.stdin.read())
"""


@pytest.mark.long
def test_a_notebook_has_its_folder_first_and_workers_do_not(tmp_path: Path):
    for name in ("signal", "json", "pickle", "numpy"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('not this one')\n")
    ended = subprocess.run(
        [sys.executable, "-P", "-c", NOTEBOOK], input=BATCH, cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout) == DONE


SCRIPT = """
import helper
from support.sweep_work import named
from dynsim.studies.processes import run_in_processes

class Here:
    name = "here"

for thing in (helper.There(), Here()):
    try:
        run_in_processes(named, [thing], 2, lambda thing, result: print(result()))
    except Exception as error:
        print(type(error).__name__, error)
"""


def test_what_is_defined_in_a_module_is_sent_and_what_is_in_the_script_is_refused(tmp_path: Path):
    (tmp_path / "helper.py").write_text("class There:\n    name = 'there'\n")
    (tmp_path / "script.py").write_text(SCRIPT)
    tests = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    ended = subprocess.run(
        [sys.executable, str(tmp_path / "script.py")],
        env=os.environ | {"PYTHONPATH": tests}, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    there, here = ended.stdout.splitlines()
    assert there == "there"
    check_message(here, "WorkerError", "Here", "jobs=1")
    assert ended.stderr == ""


@pytest.mark.parametrize(
    ("begins", "names"),
    [
        ("raise ImportError('no such thing')", ["1", "ImportError: no such thing"]),
        ("import os; os.kill(os.getpid(), 9)", ["9"]),
    ],
    ids=["fails", "killed"],
)
def test_a_worker_that_cannot_start_ends_the_batch(monkeypatch: pytest.MonkeyPatch, begins: str, names: list[str]):
    monkeypatch.setattr(processes, "START", f"{begins}\n{START}")
    with pytest.raises(WorkerError) as caught:
        run_in_processes(square, range(100), 2, lambda number, result: pytest.fail("nothing was done"), attempts=2)
    assert mentions(caught.value, *names)


# The first processes that start are killed; each counts itself in a file.
KILLED_FIRST = """
import os
with open({path!r}, "a") as file:
    file.write("x")
if os.path.getsize({path!r}) <= {count}:
    os.kill(os.getpid(), 9)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="kills with a signal")
@pytest.mark.parametrize("count", [STARTS - 1, STARTS])
def test_a_worker_that_dies_while_it_starts_is_started_again(
    count: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """No task counts it as a loss."""
    counted = tmp_path / "started"
    monkeypatch.setattr(processes, "START", f"{KILLED_FIRST.format(path=str(counted), count=count)}\n{START}")
    taken: dict[int, int] = {}

    def run() -> bool:
        return run_in_processes(square, range(3), 1, lambda number, result: taken.update({number: result()}))

    if count < STARTS:
        assert run() is False
        assert taken == {0: 0, 1: 1, 2: 4}
    else:
        with raises(WorkerError, "9"):
            run()
        assert taken == {}
    assert counted.stat().st_size == STARTS


def test_no_process_at_all_is_one_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    for executable, names in (
        ("", ()),
        (str(tmp_path / "python"), ("No such file or directory", str(tmp_path / "python"))),
    ):
        monkeypatch.setattr(sys, "executable", executable)
        with raises(WorkerError, *names):
            run_in_processes(square, range(3), 2, lambda number, result: None)


@pytest.mark.parametrize(
    ("work", "names"), [(square, ("ModuleNotFoundError", "only_here")), (unsendable, ("TextIOWrapper", "jobs=1"))]
)
def test_what_cannot_travel_is_an_error_of_its_task(
    work: Callable[..., Any], names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
):
    module = ModuleType("only_here")
    exec("class Thing: ...", module.__dict__)
    monkeypatch.setitem(sys.modules, "only_here", module)
    taken: list[str] = []

    def take(task: Any, result: Callable[[], Any]) -> None:
        with pytest.raises(WorkerError) as caught:
            result()
        taken.append(str(caught.value))

    run_in_processes(work, [module.Thing() if work is square else 1], 2, take)
    assert len(taken) == 1
    assert mentions(taken[0], *names)


def test_what_work_prints_and_reads_is_not_what_it_is_sent(capfd: pytest.CaptureFixture[str]):
    taken: dict[int, Any] = {}
    run_in_processes(says, range(3), 1, lambda number, result: taken.update({number: result()}))
    assert taken == dict.fromkeys(range(3), "")
    # A thread forwards the output, perhaps after the result.
    printed = [capfd.readouterr()]

    def is_complete() -> bool:
        printed.append(capfd.readouterr())
        return "".join(more.err for more in printed).count("printed") == 3

    wait_for(is_complete)
    assert all(more.out == "" for more in printed)


def test_workers_import_the_dynsim_of_their_parent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Not an installed dynsim, if the parent runs in a checkout."""
    (tmp_path / "dynsim").mkdir()
    (tmp_path / "dynsim" / "__init__.py").touch()
    own = Path(processes.__file__).parents[2]
    monkeypatch.chdir(own)
    others = [folder for folder in sys.path if folder and not (Path(folder) / "dynsim").is_dir()]
    monkeypatch.setattr(sys, "path", ["", *others, str(tmp_path)])
    path = isolated.search_path()
    spec = PathFinder.find_spec("dynsim", path)
    assert spec is not None
    assert spec.origin == str(own / "dynsim" / "__init__.py")
    assert path[: len(others)] == others


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="no signal stops a process here")
def test_a_worker_that_is_stopped_when_all_is_done_is_not_waited_for():
    pids: list[int] = []

    def take(number: int, result: Callable[[], int]) -> None:
        pids.append(result())
        if number == 3:
            os.kill(pids[-1], signal.SIGSTOP)

    run_in_processes(pid, range(4), 1, take)
    assert len(pids) == 4
    end_workers()


def collected(work: Callable[..., Any], tasks: Sequence[Any], jobs: int, **options: Any) -> list[Any]:
    """Results in the order of the tasks."""
    taken: dict[Any, Any] = {}
    run_in_processes(work, tasks, jobs, lambda task, result: taken.update({task: result()}), **options)
    return [taken[task] for task in tasks]


def test_workers_are_kept_for_the_next_call(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    end_workers()
    (first,) = {*collected(pid, range(3), 1)}
    assert {*collected(pid, range(3), 1)} == {first}
    assert collected(square, range(3), 1) == [0, 1, 4]
    assert {*collected(pid, range(3), 1)} == {first}
    monkeypatch.chdir(tmp_path)
    assert first not in collected(pid, range(3), 1)


def test_workers_of_older_modules_are_not_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    (tmp_path / "edited.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("edited")
    os.utime(tmp_path / "edited.py", (1.0, 1.0))
    before = collected(pid, [0], 1)
    assert collected(pid, [0], 1) == before
    os.utime(tmp_path / "edited.py")
    assert collected(pid, [0], 1) != before
    monkeypatch.delitem(sys.modules, "edited")


def test_a_worker_that_died_since_the_last_call_is_replaced():
    (before,) = collected(pid, [0], 1)
    os.kill(before, signal.SIGKILL)
    wait_for(lambda: not is_alive(before))
    assert collected(pid, [0], 1) != [before]


def is_alive(number: int) -> bool:
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_unused_workers_end(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(
        processes, "START", START.replace("serve(", "import dynsim.studies.processes as p\np.IDLE_S = 0.2\nserve(")
    )
    (before,) = collected(pid, [0], 1)
    wait_for(lambda: not is_alive(before))
    assert collected(pid, [0], 1) != [before]


def nothing(task: Any) -> None:
    """No progress function for tasks in this process."""


def test_a_short_batch_stays_in_this_process():
    end_workers()
    assert {*collected(pid, range(50), 2, here=nothing)} == {os.getpid()}
    assert not processes._kept


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_task_that_is_too_long_is_repeated_by_a_worker(jobs: int, monkeypatch: pytest.MonkeyPatch):
    """The other tasks too; with one job there is no worker."""
    monkeypatch.setattr(processes, "HERE_S", 0.05)
    pids = collected(busy, [0.001, 0.2, 0.002, 0.003], jobs, here=nothing)
    assert [number == os.getpid() for number in pids] == [True, *[jobs == 1] * 3]


@pytest.mark.long
def test_long_batches_are_shared_with_a_worker(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(processes, "ALONE_S", 0.2)
    pids = collected(busy, [0.02 + 1e-6 * k for k in range(150)], 2, here=nothing)
    assert os.getpid() in pids
    assert len({*pids}) == 2


@pytest.mark.parametrize("here", [None, nothing])
def test_an_error_of_a_task_is_raised_for_this_task(here: Any):
    errors: dict[int, str] = {}

    def take(number: int, result: Callable[[], int]) -> None:
        try:
            result()
        except ValueError as error:
            errors[number] = str(error)

    run_in_processes(square, [1, REFUSED, 2], 2, take, here=here)
    assert {*errors} == {REFUSED}


WAITS = """
from support.sweep_work import deaf
from dynsim.studies.processes import run_in_processes
import sys
run_in_processes(deaf, [(k, sys.argv[1]) for k in range(2)], 2, print)
"""


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks at processes in /proc")
def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path):
    tests = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    parent = subprocess.Popen([sys.executable, "-c", WAITS, str(tmp_path)], env=os.environ | {"PYTHONPATH": tests})
    try:
        wait_for(lambda: len(list(tmp_path.glob("begun_*"))) == 2)
        children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
    finally:
        parent.kill()
        parent.wait()
    assert len(children) == 2
    wait_for(lambda: not any(Path(f"/proc/{child}/cmdline").exists() for child in children))
