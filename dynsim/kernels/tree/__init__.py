"""Trees of rigid bodies: joints, recursive Newton–Euler sweeps, the articulated solve."""
