"""SIMD variants of scalar kernels, which evaluate four states, or two linear systems, at once."""
