"""Signals, closed pipes and full disks: simulated results are saved, and no process is left running."""

import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import IO, Any

import pytest
from support.messages import check_message, mentions, says

from dynsim.record import Record

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("hang_ups")]

# Nothing here takes this long; a test that waits for it fails.
DEADLINE_S = 240.0
VARIANTS = ("two_elbows", "elbow_7", "elbow_4", "no_elbow")
# Long enough to be stopped on the way, which the implicit method is not; cheap to prepare.
LONG = ["--set", "duration_s=5000", "--set", "controller.knot_spacing_s=10", "--set", "record.rate_hz=10"]
LONG += ["--set", "integrator.method=dopri5"]
LONG += ["--set", "controller.hand.path.period_s=5000", "--no-figures"]
# Many knots: the inverse kinematics take minutes.
PLANNING = ["--set", "duration_s=50000", "--set", "record.rate_hz=1"]

# What every Python process begins with here, workers too: it leaves files which say what the process does.
WATCHED = """
import ctypes, os
from pathlib import Path

import dynsim.library.controllers.joint_pd as joint_pd
import dynsim.integrators.driver as driver

def mark(what, function):
    def marked(*arguments):
        Path(f"{what}_{os.getpid()}").touch()
        return function(*arguments)
    return marked

# A call of advance with no step only loads the kernels.
def watched(advance):
    def run(*arguments):
        if arguments[-1] > 0:
            Path(f"simulating_{os.getpid()}").touch()
        if arguments[-1] > 0 and "STANDS" in os.environ:
            advance(*arguments[:-1], 50)
            # Like a step that does not end: without the interpreter's lock, and deaf to signals.
            ctypes.CDLL(None).pause()
        advance(*arguments)
    return run

direct = driver.direct
driver.direct = lambda run: watched(direct(run))
joint_pd.follow = mark("planning", joint_pd.follow)
"""


def prepare_child() -> None:
    """Where the tests run in the background, SIGINT is ignored and would be in their children too; no core files."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


@contextmanager
def started(
    folder: Path, *arguments: str, stdout: int | IO[Any] = subprocess.PIPE, stands: bool = False
) -> Iterator[subprocess.Popen[str]]:
    """A watched process of its own group, of which nothing is left after the block; ``stands``: in a step for ever."""
    (folder / "begins").mkdir(exist_ok=True)
    (folder / "begins" / "sitecustomize.py").write_text(WATCHED)
    path = os.pathsep.join([str(folder / "begins"), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    process = subprocess.Popen(
        [sys.executable, "-m", "dynsim", *arguments],
        env=os.environ | {"PYTHONPATH": path} | ({"STANDS": "1"} if stands else {}),
        cwd=folder, stdout=stdout, stderr=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=prepare_child,
    )  # fmt: skip
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[str] | None = None) -> None:
    """Poll a condition; fail when it does not come, or when the process ended before."""
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, f"{condition} did not come"
        time.sleep(0.05)


def pids(folder: Path, pattern: str) -> list[int]:
    """Processes that have come to what leaves files of this name."""
    return [int(path.name.rpartition("_")[2]) for path in folder.glob(f"{pattern}_*")]


def workers(folder: Path, pattern: str, process: subprocess.Popen[str]) -> list[int]:
    """Those of its workers; the process itself tries the first task for a short time."""
    return [pid for pid in pids(folder, pattern) if pid != process.pid]


def both_simulate(folder: Path, process: subprocess.Popen[str]) -> bool:
    return len(workers(folder, "simulating", process)) == 2


def is_running(pid: int) -> bool:
    """False for a process that has ended, also when nobody has asked for its exit code."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def communicate(process: subprocess.Popen[str]) -> tuple[str, str]:
    return process.communicate(timeout=DEADLINE_S)


# Twins of what is tried here already, some seconds each.
SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "number",
    [signal.SIGINT, signal.SIGTERM, pytest.param(signal.SIGHUP, marks=SLOW)],
    ids=lambda number: number.name,
)
def test_a_signal_saves_what_was_simulated(tmp_path: Path, number: signal.Signals):
    with started(tmp_path, "run", "elbow_comparison", *LONG) as process:
        wait_until(lambda: bool(pids(tmp_path, "simulating")), process)
        process.send_signal(number)
        _, stderr = communicate(process)
    assert process.returncode == 128 + number, stderr
    record = Record.load(tmp_path / "results" / "elbow_comparison" / "two_elbows" / "record.h5")
    assert not record.complete
    assert says(record.summary["warnings"][-1], "incomplete")


@pytest.mark.parametrize(
    ("number", "jobs"),
    [
        (signal.SIGINT, "1"),
        (signal.SIGTERM, "2"),
        pytest.param(signal.SIGTERM, "1", marks=SLOW),
        pytest.param(signal.SIGINT, "2", marks=SLOW),
    ],
)
def test_a_signal_ends_runs_whose_steps_do_not(tmp_path: Path, number: signal.Signals, jobs: str):
    """What was recorded before is saved, and no process is left in its step."""
    arguments = ["compare", "elbow_comparison_floor", "--jobs", jobs, *LONG, "--out", "out"]
    with started(tmp_path, *arguments, stands=True) as process:
        wait_until(
            lambda: bool(pids(tmp_path, "simulating")) if jobs == "1" else both_simulate(tmp_path, process), process
        )
        time.sleep(0.5)
        process.send_signal(number)
        _, stderr = communicate(process)
    assert process.returncode == 128 + number, stderr
    saved = [Record.load(path) for path in (tmp_path / "out").rglob("record.h5")]
    assert [record.complete for record in saved] == [False] * int(jobs)
    assert not any(is_running(pid) for pid in pids(tmp_path, "simulating"))


def test_a_signal_ends_a_sweep_whose_steps_do_not(tmp_path: Path):
    arguments = ["sweep", "elbow_comparison_floor", "--grid", "contacts.friction=0,0.1,0.2", "--jobs", "2", *LONG]
    with started(tmp_path, *arguments, "--out", "out", stands=True) as process:
        wait_until(lambda: both_simulate(tmp_path, process), process)
        process.send_signal(signal.SIGTERM)
        _, stderr = communicate(process)
    assert process.returncode == 128 + signal.SIGTERM, stderr
    assert mentions(stderr, "0", "3", "--resume")
    assert not any(is_running(pid) for pid in pids(tmp_path, "simulating"))


def test_a_signal_saves_the_variant_that_runs(tmp_path: Path):
    with started(tmp_path, "compare", "elbow_comparison", *LONG, "--out", "out") as process:
        wait_until(lambda: bool(pids(tmp_path, "simulating")), process)
        process.send_signal(signal.SIGTERM)
        _, stderr = communicate(process)
    assert process.returncode == 128 + signal.SIGTERM, stderr
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"two_elbows"}
    assert not Record.load(tmp_path / "out" / "two_elbows" / "record.h5").complete
    assert mentions(stderr.splitlines()[-1], "elbow_7, elbow_4, no_elbow")


@pytest.mark.parametrize(
    ("number", "kill"),
    [(signal.SIGINT, os.killpg), (signal.SIGTERM, os.kill), pytest.param(signal.SIGHUP, os.killpg, marks=SLOW)],
    ids=lambda value: getattr(value, "name", None) or value.__name__,
)
def test_a_signal_saves_all_variants_that_run_in_processes(
    tmp_path: Path, number: signal.Signals, kill: Callable[[int, int], None]
):
    """To the parent alone or, as a terminal sends it, to all. Two variants run, two wait."""
    with started(tmp_path, "compare", "elbow_comparison", "--jobs", "2", *LONG, "--out", "out") as process:
        wait_until(lambda: both_simulate(tmp_path, process), process)
        kill(process.pid, number)
        _, stderr = communicate(process)
    assert process.returncode == 128 + number, stderr
    *saved, error = stderr.splitlines()
    assert sorted(name for line in saved for name in VARIANTS if mentions(line, name)) == ["elbow_7", "two_elbows"]
    check_message(error, re.compile(r"^error: two_elbows: .*\bt = "), "elbow_4, no_elbow")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"elbow_7", "two_elbows"}
    for name in ("elbow_7", "two_elbows"):
        assert not Record.load(tmp_path / "out" / name / "record.h5").complete
    assert not any(is_running(pid) for pid in pids(tmp_path, "simulating"))


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes in /proc")
@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGQUIT, marks=SLOW), signal.SIGKILL], ids=lambda number: number.name
)
def test_workers_end_with_their_parent(tmp_path: Path, number: signal.Signals):
    with started(tmp_path, "compare", "elbow_comparison", "--jobs", "2", *LONG, "--out", "out") as process:
        wait_until(lambda: both_simulate(tmp_path, process), process)
        process.send_signal(number)
        process.wait(timeout=DEADLINE_S)
        wait_until(lambda: not any(is_running(pid) for pid in workers(tmp_path, "simulating", process)))
    assert process.returncode == -number


@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_while_references_are_planned_names_every_variant(tmp_path: Path, jobs: int):
    with started(tmp_path, "compare", "elbow_comparison", "--jobs", str(jobs), *PLANNING) as process:
        marked = partial(workers, process=process) if jobs > 1 else pids
        wait_until(lambda: len(marked(tmp_path, "planning")) == jobs, process)
        process.send_signal(signal.SIGINT)
        _, stderr = communicate(process)
    assert process.returncode == 130, stderr
    (error,) = stderr.splitlines()
    for name in VARIANTS[:jobs]:
        assert mentions(error, f"({name})")
    assert mentions(error, ", ".join(VARIANTS[jobs:]))
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize("command", ["run", "check"])
def test_ctrl_c_before_the_first_step_says_that_nothing_is_saved(tmp_path: Path, command: str):
    with started(tmp_path, command, "elbow_comparison", *PLANNING) as process:
        wait_until(lambda: bool(pids(tmp_path, "planning")), process)
        process.send_signal(signal.SIGINT)
        _, stderr = communicate(process)
    assert process.returncode == 130, stderr
    check_message(stderr, re.compile("^error: "), "(two_elbows)")
    assert not (tmp_path / "results").exists()


def test_a_reader_that_leaves_ends_quietly_and_loses_no_run(tmp_path: Path):
    arguments = ["single_pendulum", "--no-figures", "--set", "duration_s=0.2", "--set", "metrics.settle_s=0.05"]
    for command in (["list"], ["schema"], ["run", *arguments, "--out", "out"]):
        with started(tmp_path, *command) as process:
            process.stdout.close()
            process.stdout = None
            _, stderr = communicate(process)
        assert (process.returncode, stderr) == (128 + signal.SIGPIPE, "")
    assert Record.load(tmp_path / "out" / "record.h5").complete


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_standard_output_is_one_line_and_loses_no_run(tmp_path: Path):
    arguments = ["single_pendulum", "--no-figures", "--set", "duration_s=0.2", "--set", "metrics.settle_s=0.05"]
    for command in (["--help"], ["schema"], ["run", *arguments, "--out", "out"]):
        with open("/dev/full", "w") as full, started(tmp_path, *command, stdout=full) as process:
            _, stderr = communicate(process)
        assert process.returncode == 2
        check_message(stderr, re.compile("^error: "), "No space left on device")
    assert Record.load(tmp_path / "out" / "record.h5").complete


# A signal that comes just when something begins, to the process that does it.
SIGNALLED = """
import os, signal, sys
import dynsim.{module} as module
from dynsim.cli import main

# Not as it is inherited: a shell starts what it runs in the background with SIGINT ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
begin = {target}

def signalled(*arguments, **options):
    os.kill(os.getpid(), signal.{signal})
    return begin(*arguments, **options)

{target} = signalled
main()
"""


SUMMARY, SAVING = ("engine.recording", "module.summarise"), ("record", "module.Record.to_hdf5")


@pytest.mark.parametrize(
    ("command", "module", "target", "number"),
    [
        # Every two of command, place and signal.
        ("run", *SUMMARY, signal.SIGINT),
        ("run", *SAVING, signal.SIGTERM),
        ("compare", *SUMMARY, signal.SIGTERM),
        ("compare", *SAVING, signal.SIGINT),
        pytest.param("run", *SUMMARY, signal.SIGTERM, marks=SLOW),
        pytest.param("run", *SAVING, signal.SIGINT, marks=SLOW),
        pytest.param("compare", *SUMMARY, signal.SIGINT, marks=SLOW),
        pytest.param("compare", *SAVING, signal.SIGTERM, marks=SLOW),
    ],
    ids=lambda value: getattr(value, "name", None) or value.removeprefix("module."),
)
def test_a_signal_after_the_last_step_loses_nothing(
    tmp_path: Path, number: signal.Signals, module: str, target: str, command: str
):
    code = SIGNALLED.format(module=module, target=target, signal=number.name)
    arguments = [command, "elbow_comparison", "--set", "duration_s=0.05", "--out", "out"]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=DEADLINE_S
    )
    assert done.returncode == 128 + number, done.stderr
    assert Record.load(next((tmp_path / "out").rglob("record.h5"))).complete
    assert "Traceback" not in done.stderr
    if command == "run":
        check_message(done.stderr.splitlines()[-1], "out")
    if command == "compare":
        assert [path.name for path in (tmp_path / "out").iterdir()] == ["two_elbows"]
        assert mentions(done.stderr, "elbow_4, no_elbow")


def test_a_signal_while_figures_are_drawn_is_no_error_of_theirs(tmp_path: Path):
    with started(tmp_path, "run", "elbow_comparison", "--set", "duration_s=0.05", "--out", "out") as process:
        wait_until((tmp_path / "out" / "summary.json").exists, process)
        time.sleep(0.3)
        process.send_signal(signal.SIGINT)
        _, stderr = communicate(process)
    assert process.returncode == 128 + signal.SIGINT, stderr
    check_message(stderr.splitlines()[-1], "out")
    assert "error" not in stderr


# A signal whose KeyboardInterrupt Python drops, because it comes while a callback of the garbage collector runs.
LOST = """
import os, signal, weakref
import dynsim.engine.stopping as attended
from dynsim.cli import main

class Thing: ...

look, calls = attended.WallWatch.look, []

def lose(*arguments):
    calls.append(1)
    if len(calls) == 1:
        thing = Thing()
        watch = weakref.ref(thing, lambda _: os.kill(os.getpid(), signal.SIGTERM))
        del thing
    look(*arguments)

attended.WallWatch.look = lose
main()
"""


def test_a_signal_that_python_loses_is_heeded(tmp_path: Path):
    done = subprocess.run(
        [sys.executable, "-c", LOST, "run", "elbow_comparison", *LONG],
        cwd=tmp_path, capture_output=True, text=True, timeout=DEADLINE_S,
    )  # fmt: skip
    assert done.returncode == 128 + signal.SIGTERM, done.stderr
    assert not Record.load(next(tmp_path.rglob("record.h5"))).complete


def test_what_described_older_records_goes_with_them(tmp_path: Path):
    command = [sys.executable, "-m", "dynsim", "compare", "elbow_comparison", "--quiet", "--out", "out"]
    options = {"cwd": tmp_path, "capture_output": True, "text": True, "timeout": DEADLINE_S}
    assert subprocess.run([*command, "--set", "duration_s=0.02"], **options).returncode == 0
    out = tmp_path / "out"
    assert list(out.glob("compare_*.png"))
    code = SIGNALLED.format(module="engine.recording", target="module.summarise", signal="SIGTERM")
    again = [sys.executable, "-c", code, *command[3:], "--set", "duration_s=0.03"]
    assert subprocess.run(again, **options).returncode == 128 + signal.SIGTERM
    assert sorted(path.name for path in out.iterdir()) == ["elbow_4", "elbow_7", "no_elbow", "two_elbows"]
    assert Record.load(out / "two_elbows" / "record.h5").time[-1] == 0.03
    assert not list((out / "two_elbows").glob("figures/*"))
    assert list((out / "no_elbow").glob("figures/*"))
