"""The right-hand side on SIMD lanes: variants of kernels, tables, and four states at once."""
