"""Compilation with numba: kernel decorators, cache, compiler pipeline, struct types, SIMD."""
