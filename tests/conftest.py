"""Hypothesis draws the same examples in every run, and compiling kernels is not a slow example."""

from hypothesis import settings

settings.register_profile("seeded", derandomize=True, deadline=None, max_examples=25)
settings.load_profile("seeded")
