"""The brace planner: problem, local solver, search over brace sets, verification, result and its files."""
