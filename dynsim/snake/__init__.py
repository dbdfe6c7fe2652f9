"""Kinematic snake robot: compiled kinematics, controller, support polygon and tick loop, and data of [T]."""
