"""Decorators for compiled functions (``@kernel`` and its variants), and the cache of their machine code on disk.

The compiler pipeline is in dynsim.jit.compiler. The cache replaces numba's cache, which checks only the file of the
function itself and does not detect damaged files; after an edit of a callee in another file, numba would run old
machine code. See :class:`_KernelCache`.
"""

from __future__ import annotations

import errno
import hashlib
import os
import pickle
import re
import shutil
import stat
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import llvmlite
import numba
import numpy as np
from numba.core import config, serialize
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult

from dynsim.jit.compiler import KernelCompiler, NoInlineCompiler, PartCompiler, as_part, packs_formulas, register_part

_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}, "_nrt": False}

# Packages whose functions are compiled into each other; an edit in one of them makes all compiled code stale.
_PACKAGES = tuple(Path(__file__).parents[1] / name for name in ("jit", "dynamics", "integrators", "snake"))

F = TypeVar("F", bound=Callable[..., Any])


class _KernelCache(_Cache):
    """Machine code on disk, with one file per function and signature.

    A file contains the SHA-256 of its content, followed by numba's pickle. If a file is damaged or cannot be written,
    the kernel is compiled again, and the run continues. LLVM would abort the process on broken machine code, so a file
    is loaded only if its digest is correct. Unlike numba's cache, this cache does not load the compiler's typing and
    lowering rules (0.4 s), because machine code does not need them; the compiler loads them when it runs.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    @property
    def cache_path(self) -> str:
        return str(cache_folder())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        path = self._path(sig, target_context.codegen())
        try:
            with path.open("rb") as file:
                owner, content = os.fstat(file.fileno()).st_uid, file.read()
        except FileNotFoundError:
            for report in list(_listeners):
                report()
            return None
        except OSError as error:
            _warn(f"{path}: cannot be read ({error.strerror}); recompiling")
            return None
        if _USER is not None and owner not in (0, _USER):
            _warn(f"{path}: another user owns this file; recompiling")
            return None
        digest, payload = content[:_DIGEST_SIZE], content[_DIGEST_SIZE:]
        if hashlib.sha256(payload).digest() != digest:
            _warn(f"{path}: damaged machine code; recompiling")
            return None
        return CompileResult._rebuild(target_context, *pickle.loads(payload))

    def save_overload(self, sig: Any, data: Any) -> None:
        if data.library.has_dynamic_globals:  # the code contains addresses of this process, as with NUMBA_OPT=0
            return
        path = self._path(sig, data.codegen)
        payload = serialize.dumps(data._reduce())
        try:
            with tempfile.NamedTemporaryFile(
                dir=path.parent, prefix=f"{path.name}.", suffix=".tmp", delete=False
            ) as file:
                try:
                    file.write(hashlib.sha256(payload).digest())
                    file.write(payload)
                    file.close()
                    os.replace(file.name, path)
                except BaseException:
                    os.unlink(file.name)
                    raise
        except OSError as error:
            _warn(f"{path}: cannot be saved ({error.strerror}); the next run compiles it again")

    def _path(self, sig: Any, codegen: Any) -> Path:
        """Return a path that depends on the processor, the signature and numba's settings.

        For a function of another package, it also depends on the source code in the folder of the function.
        """
        source = Path(self._function.__code__.co_filename)
        content = b"" if _names_the_folder(source) else _sources(source.parent)
        asked = config.OPT, config.LOOP_VECTORIZE, packs_formulas(), config.BOUNDSCHECK, config.DEBUGINFO_DEFAULT
        key = repr((sig, codegen.magic_tuple(), *asked)).encode() + content
        name = f"{self._function.__module__}.{self._function.__qualname__}"
        return cache_folder() / f"{name}-{hashlib.sha256(key).hexdigest()[:16]}{_SUFFIX}"

    def enable(self) -> None: ...

    def disable(self) -> None: ...

    def flush(self) -> None: ...


def _names_the_folder(source: Path) -> bool:
    """Return whether the name of :func:`cache_folder` already depends on this source file."""
    return any(source.is_relative_to(package) for package in _PACKAGES)


@lru_cache
def _sources(folder: Path) -> bytes:
    """Return the content of all Python files in a folder; its functions are compiled into each other."""
    return b"".join(source.read_bytes() for source in sorted(folder.glob("*.py")))


_SUFFIX = ".kernel"
_DIGEST_SIZE = hashlib.sha256().digest_size


def _warn(text: str) -> None:
    warnings.warn(text, UserWarning, stacklevel=3)


@lru_cache(maxsize=1)
def cache_folder() -> Path:
    """Return the folder of the compiled kernels; its name changes when its content becomes stale.

    Only this user can write to the folder. It is in NUMBA_CACHE_DIR, XDG_CACHE_HOME, LOCALAPPDATA (Windows) or
    ~/.cache, whichever is set first. If this fails, it is in the temporary directory; if other users can write there,
    it is a private folder of this process. When a new folder is created, neighbouring folders that no process has used
    for :data:`UNUSED_S` are removed; more recent ones may belong to dynsim in another environment.
    """
    digest = hashlib.sha256(f"{sys.version} {numba.__version__} {llvmlite.__version__} {np.__version__}".encode())
    for source in (file for package in _PACKAGES for file in sorted(package.rglob("*.py"))):
        digest.update(source.read_bytes())
    name = Path("dynsim", digest.hexdigest()[:16])
    roots = [os.environ.get(variable) for variable in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "LOCALAPPDATA")]
    home = os.path.expanduser(next((root for root in roots if root), "~/.cache"))
    temporary = Path(tempfile.gettempdir(), f"cache-{_USER}")
    # For a user without a home directory, the tilde remains.
    for root in (temporary,) if home.startswith("~") else (Path(home), temporary):
        try:
            folder = (root / name).resolve()
            new = not folder.exists()
            _make_private(folder)
            os.utime(folder)  # mark the folder as in use
        except OSError as error:
            _warn(f"{root / name}: not used for compiled kernels: {error.strerror}")
            continue
        if new:
            _remove_unused(folder)
        return folder
    _warn("kernels are recompiled in every process; set XDG_CACHE_HOME to a folder that only you can write to")
    folder = Path(_of_this_process().name, name)
    folder.mkdir(parents=True)
    return folder


# None on Windows, where files do not have numeric user IDs.
_USER = os.getuid() if hasattr(os, "getuid") else None

# Kernels that no process has used for this time [s], 30 days, are removed.
UNUSED_S = 30 * 86400.0


def _make_private(folder: Path) -> None:
    """Create the folder if needed; raise OSError if users other than this one and root can change its content.

    Loading machine code executes it. A user who can write to a parent folder can replace the folder, unless the sticky
    bit of the parent is set. On systems without numeric user IDs, the folder is accepted, because file modes do not
    show who can write to it.
    """
    trusted = 0, _USER
    for part in (*reversed(folder.parents), folder):
        with suppress(FileExistsError):
            part.mkdir(mode=0o700)
        if _USER is None:
            continue
        status = part.lstat()
        # The user's own group and the root group may have write access; other groups may not.
        writable = status.st_mode & (stat.S_IWOTH if status.st_gid in trusted else stat.S_IWOTH | stat.S_IWGRP)
        sticky = part != folder and status.st_mode & stat.S_ISVTX
        if not stat.S_ISDIR(status.st_mode) or status.st_uid not in trusted or (writable and not sticky):
            raise OSError(errno.EPERM, f"another user owns {part} or can write to it")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OSError(errno.EACCES, os.strerror(errno.EACCES))


def _remove_unused(folder: Path) -> None:
    """Remove neighbouring kernel folders that have been unused for :data:`UNUSED_S`."""
    with suppress(OSError):
        for other in folder.parent.iterdir():
            if re.fullmatch("[0-9a-f]{16}", other.name) and time.time() - other.lstat().st_mtime > UNUSED_S:
                shutil.rmtree(other, ignore_errors=True)


@lru_cache(maxsize=1)
def _of_this_process() -> tempfile.TemporaryDirectory[str]:
    """Return a temporary folder that is removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="dynsim-")


@contextmanager
def on_compilation(report: Callable[[], None]) -> Iterator[None]:
    """Call ``report`` once before this process compiles a kernel that is not on disk, because this takes long."""

    def once() -> None:
        _listeners.remove(once)
        report()

    _listeners.append(once)
    try:
        yield
    finally:
        with suppress(ValueError):
            _listeners.remove(once)


_listeners: list[Callable[[], None]] = []


def kernel(function: F) -> F:
    """Compile ``function`` on first call and store the machine code on disk.

    Fast-math is limited to contraction (a·b + c with one rounding). Full fast-math would let the compiler assume that
    NaN does not occur, but NaN must be preserved so that divergence is detected. With ``error_model="numpy"``, a
    division by zero gives inf or NaN and does not branch. Kernels do not allocate memory, so numba's reference counting
    of arrays is switched off (``_nrt``); its atomic operations would cost a tenth of a right-hand side.
    """
    return _compile(function)


def free_kernel(function: F) -> F:
    """Compile like :func:`kernel`, and release the interpreter lock during calls, so that other threads can run.

    This decorator is for long-running functions that only Python calls; see dynsim.engine.stopping.
    """
    return _compile(function, nogil=True)


def inline_kernel(function: F) -> F:
    """Compile like :func:`kernel`, and inline the function into its caller before compilation.

    This decorator is for functions that call the right-hand side. A compiled function includes the code of all its
    callees, so each additional level would compile the right-hand side again.
    """
    return _compile(function, inline="always")


def internal_kernel(function: F) -> F:
    """Compile a function as part of the kernels that call it; in Python it remains the plain function.

    Unpacking the tables of a model from Python objects would take longer to compile than most of these functions.
    """
    return register_part(function, PartCompiler, _OPTIONS)


def noinline_kernel(function: F) -> F:
    """Compile like :func:`internal_kernel`, but never inline the function into its callers.

    This decorator is for functions that the right-hand side rarely calls. If they were inlined, they would occupy
    registers of the code that runs every time.
    """
    return register_part(function, NoInlineCompiler, _OPTIONS)


def exact_kernel(function: F) -> F:
    """Compile like :func:`internal_kernel`, but round every product.

    This decorator is for functions that are inlined in several places. The products of a sum that the compiler
    contracts depend on the place, and so would the last bits of the result.
    """
    return register_part(function, PartCompiler, {**_OPTIONS, "fastmath": False, "forceinline": True})


class FixedSignature:
    """Kernel that is called repeatedly with arguments of the same types as in the first call.

    Numba determines the types of all arguments in each call; for a hundred tables, this takes as long as running many
    kernels. This class determines them in the first call, so an array of another type would be misread. Objects of
    this class for the same kernel share the compiled signatures.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function, self._entry = function, function if config.DISABLE_JIT else None

    def __call__(self, *arguments: Any) -> Any:
        if self._entry is None:
            function: Any = self._function
            key = function, _traits(arguments)
            if key not in _entries:
                _entries[key] = function.compile(tuple(map(function.typeof_pyval, arguments)))
            self._entry = _entries[key]
        return self._entry(*arguments)


_entries: dict[Any, Any] = {}


def _traits(value: Any) -> Any:
    """Return everything that determines numba's type of an argument; this takes a tenth of the time of ``typeof``."""
    if isinstance(value, np.ndarray):
        return value.dtype, value.ndim, value.flags.num
    return (type(value), *map(_traits, value)) if isinstance(value, tuple) else type(value)


def _compile(function: F, **options: Any) -> F:
    compiled = numba.njit(pipeline_class=KernelCompiler, no_cfunc_wrapper=True, **_OPTIONS, **options)(function)
    if not config.DISABLE_JIT:
        compiled._cache = _KernelCache(function)
        if not options:  # other kernels include this function and do not need a separate entry
            part = as_part(function, _OPTIONS)
            compiled.get_call_template, compiled.get_overload = part.get_call_template, part.get_overload
    return compiled


@internal_kernel
def every(mask):
    """Return whether a condition is true, on lanes for all of them, see :mod:`dynsim.jit.simd`."""
    return mask


def reals(values: Any) -> np.ndarray:
    """Return a copy of ``values`` as a float array for kernels: float64, in C order, writable."""
    return np.array(values, dtype=np.float64, order="C")


def integers(values: Any) -> np.ndarray:
    """Return a copy of ``values`` as an integer array for kernels: int64, in C order, writable."""
    return np.array(values, dtype=np.int64, order="C")
