"""Package: licence, type marker, citation, public names, use without POSIX modules, caps on dependencies."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from ruamel.yaml import YAML
from support.messages import check_message, raises

import dynsim

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_types_are_marked_and_the_licence_is_there() -> None:
    assert (Path(dynsim.__file__).parent / "py.typed").is_file()
    assert PROJECT["license-files"] == ["LICENSE"]
    assert (
        (ROOT / "LICENSE").read_text(encoding="utf-8").startswith(f"{PROJECT['license']} License\n\nCopyright (c) 2026")
    )


def test_the_citation_is_of_this_version_and_names_both_papers() -> None:
    citation = YAML(typ="safe").load(ROOT / "CITATION.cff")
    assert (citation["cff-version"], citation["title"]) == ("1.2.0", PROJECT["name"])
    assert (str(citation["version"]), citation["license"]) == (dynsim.__version__, PROJECT["license"])
    families = [[author["family-names"] for author in paper["authors"]] for paper in citation["references"]]
    assert families == [["Wang", "Minami"], ["Tanaka", "Tadakuma", "Nakajima", "Fujita"]]
    # Titles as in the documentation, whose line breaks differ.
    for paper, page in zip(citation["references"], ("theory/multibody.md", "snake.md"), strict=True):
        assert paper["title"] in " ".join((ROOT / "docs" / page).read_text(encoding="utf-8").split())


def test_what_is_public_can_be_had_and_is_all_that_is_listed() -> None:
    for name in dynsim.__all__:
        assert getattr(dynsim, name) is not None
    assert dir(dynsim) == sorted(dynsim.__all__)
    with raises(AttributeError, "dynsim", "viewer"):
        _ = dynsim.viewer


def test_pages_films_and_braces_are_at_the_top_without_another_import() -> None:
    code = "import dynsim; print(dynsim.view.write.__name__, dynsim.film.write.__name__, dynsim.Brace.__name__)"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert (done.stdout, done.stderr) == ("write write Brace\n", "")


# Libraries that the command must not import; scipy itself is imported by numba, so one of its parts stands for it.
RUN = {"scipy.interpolate", "scipy.linalg", "scipy.optimize", "scipy.spatial", "matplotlib", "PIL", "serial", "asyncio"}
WAITING = {
    "--help": RUN | {"numba", "ruamel", "pydantic", "h5py"},
    "hw --help": RUN | {"numba", "ruamel", "h5py"},
    "check elbow_comparison": RUN | {"h5py"},
    "run elbow_comparison --variant two_elbows --set duration_s=0.1 --no-figures": RUN,
    "run snake_pick_up --variant lifts --set duration_s=0.1 --no-figures": RUN,
}
IMPORTED = """
import atexit, sys
heavy, command = sys.argv[1:]
atexit.register(lambda: print("imported", *sorted(set(sys.modules) & set(heavy.split(",")))))
from dynsim.cli import main
sys.argv[1:] = command.split()
main()
"""


@pytest.mark.parametrize("command", WAITING)
def test_heavy_libraries_wait_until_they_are_needed(command: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-P", "-c", IMPORTED, ",".join(WAITING[command]), command],
        cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert (done.stdout.splitlines()[-1].split(), done.returncode) == (["imported"], 0), done.stderr


WITHOUT_POSIX = """
import os, signal, sys
import dynamixel_sdk  # its serial port knows other systems, but not this one without its modules
for name in ("fcntl", "termios", "tty", "pty", "pwd", "grp", "resource", "readline"):
    sys.modules[name] = None
for name in ("getuid", "getpgrp", "geteuid", "getegid", "fchmod", "fchown", "openpty", "ttyname", "fork", "killpg",
             "setsid", "nice", "sched_getaffinity", "getloadavg", "O_NOFOLLOW", "O_NONBLOCK", "O_DIRECTORY"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGHUP", "SIGPIPE", "SIGKILL", "SIGQUIT", "SIGTSTP", "pthread_sigmask"):
    delattr(signal, name)
import importlib, pkgutil
import dynsim
for module in pkgutil.walk_packages(dynsim.__path__, "dynsim."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
from typer.testing import CliRunner
from dynsim.cli.commands import app
for line in sys.stdin:
    done = CliRunner().invoke(app, line.split())
    print(done.exit_code, done.exception or "")
"""
WITH_THEM_OR_NOT = {
    "run single_pendulum --set duration_s=0.1 --no-figures": "0 ",
    "export single_pendulum --format urdf": "0 ",
    "run elbow_comparison --variant two_elbows --set duration_s=0.2 --no-figures --out run": "0 ",
    "hw replay run/record.h5 --map arm --port virtual --quiet": "0 ",
    "hw scan --port COM1": "1 COM1 POSIX",
}


@pytest.mark.long
def test_an_arm_runs_where_parts_of_posix_are_not(tmp_path: Path) -> None:
    """Modules and functions that Windows does not have are gone before the first import."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", WITHOUT_POSIX], input="\n".join(WITH_THEM_OR_NOT),
        capture_output=True, text=True, timeout=600, check=False, cwd=tmp_path,
    )  # fmt: skip
    *rows, refused = done.stdout.splitlines()
    *expected, names = WITH_THEM_OR_NOT.values()
    assert rows == expected, done.stderr
    check_message(refused, *names.split())


def test_no_dependency_is_capped_without_a_reason() -> None:
    lines = (ROOT / "pyproject.toml").read_text(encoding="utf-8").splitlines()
    capped = [line for line in lines if ("<" in line or "==1" in line) and line.strip().startswith('"')]
    of_names = [line for line in capped if "python_version" not in line.split("<")[0]]
    assert [line for line in of_names if "#" not in line and "dynamixel-sdk" not in line] == []


def test_pictures_read_no_keys_of_scenarios() -> None:
    package = Path(dynsim.__file__).parent
    reading = [path for path in (package / "draw").rglob("*.py") if "provenance" in path.read_text(encoding="utf-8")]
    assert reading == []


def test_wrong_settings_of_numba_are_one_error() -> None:
    done = subprocess.run(
        [sys.executable, "-P", "-m", "dynsim", "check", "single_pendulum"],
        env=os.environ | {"NUMBA_NUM_THREADS": "0"}, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "NUMBA_" in done.stderr
