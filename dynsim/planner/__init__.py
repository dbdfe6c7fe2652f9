"""Brace planner: problem, local solver, search over brace sets, verification, result and output files."""
