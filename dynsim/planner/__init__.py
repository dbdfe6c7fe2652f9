"""Where an arm braces itself, in what posture and with what forces: problem, local solver, search, and verification."""
