"""Reference motions: inverse kinematics along paths, splines, feed-forward."""
