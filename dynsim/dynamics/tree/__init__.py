"""Trees of bodies: spatial algebra, joints, recursive sweeps, the articulated solve, loads, ground reactions."""
