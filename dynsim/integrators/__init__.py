"""Compiled integrators: radau5, dopri5 and time stepping, with events, dense output and projection."""
