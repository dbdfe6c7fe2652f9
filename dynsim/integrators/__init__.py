"""Compiled integrators: RADAU5, DOPRI5 and time stepping, with events, impacts, dense output and projection."""
