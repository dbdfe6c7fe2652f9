"""Trees of bodies: recursive sweeps, articulated inertias, joints, loads."""
