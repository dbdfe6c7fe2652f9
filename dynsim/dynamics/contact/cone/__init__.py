"""Solvers of contact problems with friction cones, and of second-order cone programs."""
