"""Python files in the working directory are not imported or run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from dynsim.record import Record

pytestmark = pytest.mark.long

# What dynsim and its libraries import, under the names of the user's own files.
NAMES = ("json", "signal", "numpy", "random", "resource", "h5py", "io")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a record, and with modules that leave a mark when they are run."""
    record = Record([0.0, 0.5, 1.0])
    record.add("q", [[0.0], [0.1], [0.2]], "rad", labels=("joint_1",))
    record.save(tmp_path / "record.h5")
    for name in NAMES:
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'mark')!r}, 'a').write({name!r})\n")
    return tmp_path


@pytest.mark.parametrize(
    "arguments",
    [
        ("export", "record.h5", "--format", "csv"),
        ("plot", "record.h5"),
        ("view", "record.h5", "--no-open"),
        ("list",),
        ("check", "single_pendulum"),
        ("export", "record.h5", "--format", "csv", "--trust"),
    ],
)
def test_a_command_runs_nothing_of_the_working_directory(folder: Path, arguments: tuple[str, ...]) -> None:
    command = Path(sys.executable).with_name("dynsim")
    done = subprocess.run([command, *arguments], cwd=folder, capture_output=True, text=True, timeout=300)
    assert not (folder / "mark").exists(), (folder / "mark").read_text()
    assert "Traceback" not in done.stderr


SPAWN = """
import sys
from multiprocessing import get_context
from dynsim.teleop.web.follower import safe_path

if __name__ == "__main__":
    with safe_path():
        process = get_context("spawn").Process(target=print, args=("started",))
        process.start()
    process.join()
    sys.exit(process.exitcode)
"""


def test_the_process_of_a_drive_runs_nothing_of_the_working_directory(folder: Path, tmp_path_factory) -> None:
    script = tmp_path_factory.mktemp("elsewhere") / "drive.py"
    script.write_text(SPAWN)
    done = subprocess.run([sys.executable, script], cwd=folder, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout) == (0, "started\n"), done.stderr
    assert not (folder / "mark").exists()
