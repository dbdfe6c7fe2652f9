"""Compilation with numba: kernel decorators, cache, compiler pipeline, struct types, SIMD."""

from dynsim.errors import DynsimError

try:
    import numba  # noqa: F401
except ImportError:
    raise
except Exception as error:  # an invalid environment variable
    raise DynsimError(f"numba cannot be imported: {error} Check the environment variables NUMBA_*") from error
