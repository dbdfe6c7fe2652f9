"""All that touches numba: compilation, its cache, struct types, SIMD."""
