"""Reproducible machine code: the same numbers whatever was compiled or loaded before; folders of the kernel cache."""

from __future__ import annotations

import os
import pickle
import re
import shutil
import struct
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numba
import pytest
from llvmlite.binding import ObjectFileRef
from support.messages import mentions, warns

import dynsim
from dynsim.dynamics.tree.sweep import newton_euler
from dynsim.jit import compiler
from dynsim.jit import kernel as jit
from dynsim.planner.compiled.solve import solve

pytestmark = pytest.mark.long

SHORT = {"duration_s": 0.3}

HASH_OF_RUN = """
import hashlib, sys
import numpy as np
import dynsim
from dynsim.engine.simulation import prepare
from dynsim.dynamics.derivative import derivative

scenario = dynsim.load_scenario("elbow_comparison", overrides={"duration_s": 0.3})
if "derivative" in sys.argv:
    prepared = prepare(scenario)
    derivative(prepared.system, 0.0, prepared.run.y.copy(), prepared.workspace, np.zeros_like(prepared.run.y))
if "model" in sys.argv:
    model = dynsim.build_model(scenario)
    model.mass_matrix(model.robot.initial)
    model.kinetic_energy(model.robot.initial, model.robot.initial)
    model.potential_energy(model.robot.initial)
record = dynsim.simulate(scenario)
digest = hashlib.sha256()
for name in record:
    digest.update(np.ascontiguousarray(record[name]).tobytes())
print(digest.hexdigest())
"""


def _hash_of_run(*used_before: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", HASH_OF_RUN, *used_before], capture_output=True, text=True, check=True, timeout=300
    )
    return done.stdout.strip()


def test_numbers_do_not_depend_on_what_was_used_before() -> None:
    # The first process may have to compile; the second then loads the drivers alone.
    assert len({_hash_of_run("derivative"), _hash_of_run(), _hash_of_run("model", "derivative")}) == 1


def _weak_functions(machine_code: bytes) -> int:
    """Functions of an ELF object that another one of the same name, loaded earlier, would replace."""
    table = next(
        section.data() for section in ObjectFileRef.from_data(machine_code).sections() if section.name() == b".symtab"
    )
    symbols = struct.iter_unpack("<IBBHQQ", table)
    return sum(1 for _, info, _, section, _, _ in symbols if info >> 4 == 2 and info & 15 == 2 and section != 0)


@pytest.mark.skipif(sys.platform != "linux", reason="reads ELF objects")
def test_no_function_can_be_replaced_by_one_loaded_earlier() -> None:
    dynsim.simulate(dynsim.load_scenario("elbow_comparison", overrides=SHORT))
    files = list(jit.cache_folder().glob("dynsim.*.kernel"))
    drivers = [file for file in files if ".advance_" in file.name]
    assert drivers, files
    for file in files:
        library = pickle.loads(file.read_bytes()[32:])[0]
        assert _weak_functions(library[2][0]) == 0, file.name


MACHINE_CODE = """
import hashlib, pickle, sys
import numpy as np
from contextlib import nullcontext
from dynsim.jit import compiler, kernel as jit
from dynsim.dynamics.tree.sweep import kinematics
from support.random_robots import assemble, random_robot

if "numba's" in sys.argv:
    compiler._quick_look_ups = nullcontext
b = assemble(random_robot(np.random.default_rng(1), 3))
kinematics(b.system.model, b.ws)
(file,) = jit.cache_folder().glob("*.kinematics-*")
print(hashlib.sha256(pickle.loads(file.read_bytes()[32:])[0][2][0]).hexdigest())
"""


def _machine_code(folder: Path, *how: str) -> str:
    """A hash of a kernel compiled in an empty cache."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder), "PYTHONPATH": os.pathsep.join(sys.path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", MACHINE_CODE, *how],
        capture_output=True, text=True, check=True, timeout=300, env=environment,
    )  # fmt: skip
    return done.stdout


def test_quick_look_ups_change_no_machine_code(tmp_path: Path) -> None:
    assert _machine_code(tmp_path / "quick") == _machine_code(tmp_path / "slow", "numba's")


@pytest.fixture
def kernel_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache folder of its own."""
    monkeypatch.setattr(jit, "cache_folder", lambda: tmp_path)
    return tmp_path


def _double() -> int:
    """3 doubled, by a kernel that is not loaded yet."""

    @jit.kernel
    def double(x):  # type: ignore[no-untyped-def]
        return 2 * x

    return int(double(3))


@pytest.mark.parametrize("damage", ["machine code", "digest", "cut", "empty"])
def test_damaged_machine_code_is_compiled_anew(kernel_files: Path, damage: str) -> None:
    assert _double() == 6
    (file,) = kernel_files.iterdir()
    whole = file.read_bytes()
    middle = len(whole) // 2
    file.write_bytes(
        {
            "machine code": whole[:middle] + bytes(64) + whole[middle + 64 :],
            "digest": bytes([whole[0] ^ 1]) + whole[1:],
            "cut": whole[:middle],
            "empty": b"",
        }[damage]
    )
    with warns(UserWarning, str(file)):
        assert _double() == 6
    assert len(file.read_bytes()) == len(whole)
    assert _double() == 6  # a warning would be an error


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no numeric owners")
def test_machine_code_of_another_user_is_recompiled(kernel_files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _double()
    (file,) = kernel_files.iterdir()
    if os.getuid() == 0:
        os.chown(file, 4242, -1)
    else:
        monkeypatch.setattr("dynsim.jit.kernel._USER", os.getuid() + 1)
    with warns(UserWarning, "another user owns this file"):
        assert _double() == 6


def test_who_asks_is_told_once_that_a_kernel_is_compiled(kernel_files: Path) -> None:
    messages: list[str] = []
    with jit.on_compilation(lambda: messages.append("before")):
        _double()
    assert messages == ["before"]
    with jit.on_compilation(lambda: messages.append("from the cache")):
        _double()
    assert messages == ["before"]
    (file,) = kernel_files.iterdir()
    file.unlink()
    _double()
    assert messages == ["before"]


def test_machine_code_that_cannot_be_kept_costs_no_run(kernel_files: Path, monkeypatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with warns(UserWarning, "No space left on device"):
        assert _double() == 6
    assert list(kernel_files.iterdir()) == []


@pytest.fixture
def roots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Folders for caches and for what is temporary, which are not there yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "above" / "first"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path / "second"))
    return tmp_path / "above" / "first", tmp_path / "second"


def _given_to(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """As if another user owned a folder."""
    lstat = Path.lstat

    def changed(path: Path) -> os.stat_result:
        status = lstat(path)
        if path != folder:
            return status
        return os.stat_result((*status[:4], os.getuid() + 12345, *status[5:]))

    monkeypatch.setattr(Path, "lstat", changed)


@pytest.mark.parametrize("level", range(4))
@pytest.mark.parametrize("danger", ["writable", "a stranger's"])
def test_a_folder_is_not_used_where_others_can_write(
    roots: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, level: int, danger: str
) -> None:
    """Nor one below it: it could be replaced."""
    find = jit.cache_folder.__wrapped__
    folder = find()
    assert folder.is_relative_to(roots[0])
    assert folder.stat().st_mode & 0o777 == 0o700
    ancestor = (folder, *folder.parents)[level]
    if danger == "writable":
        ancestor.chmod(0o777)
    else:
        _given_to(monkeypatch, ancestor)
    with warns(UserWarning, str(folder), str(ancestor)):
        assert find().is_relative_to(roots[1])


def test_sticky_folders_hold_folders_of_their_own_for_everybody(roots: tuple[Path, Path]) -> None:
    roots[0].mkdir(parents=True)
    roots[0].chmod(0o1777)
    assert jit.cache_folder.__wrapped__().is_relative_to(roots[0])


def test_a_link_leads_to_a_folder_that_is_looked_at(roots: tuple[Path, Path]) -> None:
    elsewhere = roots[1] / "elsewhere"
    elsewhere.mkdir(parents=True)
    roots[0].parent.mkdir()
    roots[0].symlink_to(elsewhere)
    assert jit.cache_folder.__wrapped__().is_relative_to(elsewhere)
    elsewhere.chmod(0o777)
    with warns(UserWarning, str(elsewhere)):
        assert not jit.cache_folder.__wrapped__().is_relative_to(elsewhere)


def test_without_a_home_and_with_a_stranger_in_the_temporary_folder_each_process_has_its_own(
    roots: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    shared = roots[1] / f"cache-{os.getuid()}"
    shared.mkdir(parents=True)
    _given_to(monkeypatch, shared)
    own = roots[1] / "own"
    own.mkdir()
    monkeypatch.setattr(jit, "_of_this_process", lambda: SimpleNamespace(name=str(own)))
    with warns(UserWarning, "XDG_CACHE_HOME") as warned:
        folder = jit.cache_folder.__wrapped__()
    assert folder.is_relative_to(own)
    # What is written beside the folder is out of reach as well.
    assert folder.parent != own
    assert mentions(warned[0].message, str(shared))
    assert mentions(warned[1].message, "XDG_CACHE_HOME")
    assert not list(shared.iterdir())


def test_a_new_folder_removes_those_that_are_unused(roots: tuple[Path, Path]) -> None:
    beside, now = roots[0] / "dynsim", time.time()
    for name, age in {"0" * 16: 31, "1" * 16: 29, "notes": 400, "2" * 15: 400}.items():
        (beside / name).mkdir(parents=True)
        (beside / name / "a.kernel").touch()
        os.utime(beside / name, times=(now - age * 86400,) * 2)
    folder = jit.cache_folder.__wrapped__()
    assert {entry.name for entry in beside.iterdir()} == {"1" * 16, "notes", "2" * 15, folder.name}
    # Use is a touch.
    os.utime(folder, times=(0, 0))
    assert jit.cache_folder.__wrapped__() == folder
    assert folder.stat().st_mtime >= now - 60


def test_another_python_has_another_folder(roots: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    folder = jit.cache_folder.__wrapped__()
    monkeypatch.setattr(sys, "version", sys.version.replace("3.", "3.9"))
    assert jit.cache_folder.__wrapped__() != folder


@pytest.mark.parametrize("option", ["OPT", "LOOP_VECTORIZE", "BOUNDSCHECK"])
def test_what_is_asked_of_numba_has_machine_code_of_its_own(
    kernel_files: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    assert _double() == 6
    monkeypatch.setattr(numba.config, option, 1 if option != "LOOP_VECTORIZE" else 0)
    assert _double() == 6
    assert len(list(kernel_files.iterdir())) == 2


def test_formulas_are_packed_unless_the_user_says_no(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_SLP_VECTORIZE", raising=False)
    assert compiler.packs_formulas()
    monkeypatch.setenv("NUMBA_SLP_VECTORIZE", "0")
    assert not compiler.packs_formulas()


def test_every_kernel_is_compiled_by_the_one_place_that_knows_how() -> None:
    assert isinstance(newton_euler._cache, jit._KernelCache)  # type: ignore[attr-defined]


def _folder(packages: tuple[Path, ...], monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(jit, "_PACKAGES", packages)
    return str(jit.cache_folder.__wrapped__().name)


def test_an_edit_of_any_compiled_source_names_another_folder(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    originals = jit._PACKAGES
    copies = tuple(tmp_path / package.name for package in originals)
    for original, copy in zip(originals, copies, strict=True):
        shutil.copytree(original, copy, ignore=shutil.ignore_patterns("__pycache__"))
    folders = {_folder(originals, monkeypatch)}
    assert _folder(copies, monkeypatch) in folders
    sources = [source for copy in copies for source in copy.rglob("*.py")]
    for source in sources:
        with source.open("a") as file:
            file.write("# edited\n")
        folders.add(_folder(copies, monkeypatch))
    assert len(folders) == 1 + len(sources)


def test_every_file_with_kernels_is_in_a_package_that_names_the_folder() -> None:
    """Or is in a folder whose kernels no other folder compiles in: the planner, the filling of faces."""
    decorators = re.compile(r"^@((merged|internal|exact|apart|free)_)?kernel$", re.MULTILINE)
    package = Path(dynsim.__file__).parent
    elsewhere = {
        str(source.relative_to(package).parent)
        for source in package.rglob("*.py")
        if not jit._names_the_folder(source) and decorators.search(source.read_text(encoding="utf-8"))
    }
    assert elsewhere == {"draw/film", "planner/compiled"}


def test_edit_of_any_file_of_planner_kernels_makes_their_machine_code_stale(tmp_path: Path) -> None:
    original, copy = Path(solve.py_func.__code__.co_filename).parent, tmp_path / "compiled"
    shutil.copytree(original, copy, ignore=shutil.ignore_patterns("__pycache__"))
    contents = {jit._sources.__wrapped__(original)}
    assert jit._sources.__wrapped__(copy) in contents
    sources = list(copy.glob("*.py"))
    for source in sources:
        with source.open("a") as file:
            file.write("# edited\n")
        contents.add(jit._sources.__wrapped__(copy))
    assert len(contents) == 1 + len(sources) > 5
