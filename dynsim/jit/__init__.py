"""Everything that uses numba: compilation, cache, struct types, SIMD."""
