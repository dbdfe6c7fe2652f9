"""SIMD lanes: variants of scalar kernels that evaluate four states, or two linear systems, at once."""
