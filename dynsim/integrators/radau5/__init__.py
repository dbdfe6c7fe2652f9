"""Radau IIA method of order 5: step, Newton iteration, linear systems, end of a step, tables."""
