"""The one place that compiles: ``@kernel`` on plain module-level functions.

``cache=True`` of numba checks only the file that holds the function: an edit in a callee elsewhere silently runs old
machine code. So the cache lives in a folder named by a hash of all kernel sources and the numba version.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numba
import numba.extending
import numpy as np
from numba.core import config

# Packs the scalar formulas of 3-vectors and wrenches into vector instructions (numba leaves it off): a right-hand side
# takes 8 % less time. Global, and read when numba compiles its first function in the process.
config.SLP_VECTORIZE = 1

_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}, "_nrt": False}
_NO_ENTRY: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}

F = TypeVar("F", bound=Callable[..., Any])


@lru_cache(maxsize=1)
def cache_folder() -> Path:
    """Folder of the compiled kernels: user-writable, named by what would make its content stale."""
    digest = hashlib.sha256(f"{numba.__version__} {np.__version__}".encode())
    for source in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(source.read_bytes())
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    name = Path("dynsim", digest.hexdigest()[:16])
    roots = [Path(tempfile.gettempdir(), f"cache-{os.getuid()}")]
    with suppress(RuntimeError):  # a user without a home
        roots.insert(0, Path(base).expanduser())
    for root in roots:
        try:
            (root / name).mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(root / name, os.W_OK):
            return root / name
    return Path(tempfile.mkdtemp(prefix="dynsim-"))


def is_cached() -> bool:
    """True when compiled kernels of these sources are on disk (a first run compiles them)."""
    return any(cache_folder().rglob("*.nbi"))


def kernel(function: F) -> F:
    """Compile ``function`` on first call and keep the machine code on disk.

    Of fast-math only contraction (a·b + c in one rounding) is allowed: reordering would let the compiler assume that
    there are no NaNs, and NaN must stay NaN so that divergence is seen. ``error_model="numpy"``: a division by zero
    gives inf or NaN and does not branch. Kernels allocate nothing, so numba's reference counting of arrays is switched
    off (``_nrt``): its atomic operations cost a tenth of a right-hand side.
    """
    return _compile(function)


def merged_kernel(function: F) -> F:
    """As :func:`kernel`, for callers of the right-hand side: merged into their caller before compilation.

    A compiled function carries the code of all it calls, so each extra level would compile the right-hand side again.
    """
    return _compile(function, inline="always")


def internal_kernel(function: F) -> F:
    """For what only kernels call: compiled as part of them. From Python it is the plain function that it was.

    Unpacking the tables of a model from Python objects would take longer to compile than most of these functions.
    """
    return numba.extending.register_jitable(**_OPTIONS, **_NO_ENTRY)(function)


def inlined_kernel(function: F) -> F:
    """As :func:`internal_kernel`, for the parts of one right-hand side: merged into their caller by LLVM.

    Passing the tables of a model costs about as much as a whole sweep over ten links.
    """
    return numba.extending.register_jitable(**_OPTIONS, **_NO_ENTRY, forceinline=True)(function)


def _compile(function: F, **options: Any) -> F:
    previous = config.CACHE_DIR
    config.CACHE_DIR = str(cache_folder())
    try:
        return numba.njit(cache=True, **_OPTIONS, **options)(function)
    finally:
        config.CACHE_DIR = previous


def reals(values: Any) -> np.ndarray:
    """The canonical float array of every kernel argument: float64, C order, writable, a copy."""
    return np.array(values, dtype=np.float64, order="C")


def integers(values: Any) -> np.ndarray:
    """The canonical integer array of every kernel argument: int64, C order, writable, a copy."""
    return np.array(values, dtype=np.int64, order="C")
