"""Reference motions: inverse kinematics along paths, plane curves, teleoperation, feed-forward voltages."""
