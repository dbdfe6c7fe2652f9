"""The same version gives the same numbers, whatever a process has compiled, loaded or found in its cache before."""

from __future__ import annotations

import os
import pickle
import re
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from llvmlite.binding import ObjectFileRef

import dynsim
from dynsim.dynamics.tree.sweep import newton_euler
from dynsim.jit import kernel as jit

pytestmark = pytest.mark.long

SHORT = {"duration_s": 0.3}

HASH_OF_RUN = """
import hashlib, sys
import numpy as np
import dynsim
from dynsim.engine.dynamics import prepare
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
    files = list(jit.cache_folder().glob("dynsim.dynamics.*.kernel"))
    drivers = [file for file in files if ".advance_explicit-" in file.name]
    assert drivers, files
    for file in files:
        library = pickle.loads(file.read_bytes()[32:])[0]
        assert _weak_functions(library[2][0]) == 0, file.name


MACHINE_CODE = """
import hashlib, pickle, sys
import numpy as np
from types import ModuleType

if "unmended" in sys.argv:
    sys.modules["dynsim.jit.numba_patches"] = ModuleType("numba_habits")
import numba.core.types.functions as functions
from dynsim.jit import kernel as jit
from dynsim.dynamics.tree.sweep import kinematics
from tests.random_robots import bench, random_robot

print(functions.BaseFunction.get_call_type.__module__)
b = bench(random_robot(np.random.default_rng(1), 3))
kinematics(b.system.model, b.ws)
(file,) = jit.cache_folder().glob("*.kinematics-*")
print(hashlib.sha256(pickle.loads(file.read_bytes()[32:])[0][2][0]).hexdigest())
"""


def _machine_code(folder: Path, *how: str) -> list[str]:
    """Where numba's rules are looked up, and a hash of a kernel compiled in an empty cache."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder), "PYTHONPATH": os.pathsep.join(sys.path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", MACHINE_CODE, *how],
        capture_output=True, text=True, check=True, timeout=300, env=environment,
    )  # fmt: skip
    return done.stdout.split()


def test_mended_habits_of_numba_change_no_machine_code(tmp_path: Path) -> None:
    where, mended = _machine_code(tmp_path / "mended")
    assert where == "dynsim.jit.numba_patches"
    where, unmended = _machine_code(tmp_path / "unmended", "unmended")
    assert where == "numba.core.types.functions"
    assert mended == unmended


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
    with pytest.warns(UserWarning, match=f"{file}: damaged machine code; compiling it anew"):
        assert _double() == 6
    assert len(file.read_bytes()) == len(whole)
    assert _double() == 6  # a warning would be an error


def test_who_asks_is_told_once_that_a_kernel_is_compiled(kernel_files: Path) -> None:
    told: list[str] = []
    with jit.told_of_compilation(lambda: told.append("before")):
        _double()
    assert told == ["before"]
    with jit.told_of_compilation(lambda: told.append("from the cache")):
        _double()
    assert told == ["before"]
    (file,) = kernel_files.iterdir()
    file.unlink()
    _double()
    assert told == ["before"]


def test_machine_code_that_cannot_be_kept_costs_no_run(kernel_files: Path, monkeypatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.warns(UserWarning, match="No space left on device"):
        assert _double() == 6
    assert list(kernel_files.iterdir()) == []


def test_folders_of_others_are_not_used(tmp_path: Path, monkeypatch) -> None:
    mine = jit.cache_folder.__wrapped__
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "first"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path / "second"))
    folder = mine()
    assert folder.is_relative_to(tmp_path / "first")
    folder.chmod(0o777)
    with pytest.warns(UserWarning, match=f"{folder}: not used"):
        assert mine().is_relative_to(tmp_path / "second")
    folder.chmod(0o700)
    folder.rename(folder.with_name("elsewhere"))
    folder.symlink_to(folder.with_name("elsewhere"))
    with pytest.warns(UserWarning, match=f"{folder}: not used"):
        assert mine().is_relative_to(tmp_path / "second")
    # Somebody else's: this process becomes somebody else.
    folder.unlink()
    mine()
    monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
    with pytest.warns(UserWarning, match="not used"):
        assert not mine().is_relative_to(tmp_path / "first")


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
    """Or holds none that another file compiles in: the benchmark's loop, whose file names its machine code."""
    decorators = re.compile(r"^@((merged|internal|exact|apart|separate)_)?kernel$", re.MULTILINE)
    package = Path(dynsim.__file__).parent
    elsewhere = {
        str(source.relative_to(package))
        for source in package.rglob("*.py")
        if not jit._names_the_folder(source) and decorators.search(source.read_text(encoding="utf-8"))
    }
    assert elsewhere == {"studies/bench/right_hand_side.py"}
