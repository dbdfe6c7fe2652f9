"""SIMD variants of the derivative: several states at once."""
