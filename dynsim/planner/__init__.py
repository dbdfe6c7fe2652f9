"""The brace planner: problem, local solver, search over brace sets, and verification."""
