"""Radau IIA of order 5: stages, Newton iteration, linear systems."""
