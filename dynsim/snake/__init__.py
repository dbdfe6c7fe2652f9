"""Kinematic snake robot: compiled kinematics, controller, support polygon and tick loop, and published data of [T]."""
