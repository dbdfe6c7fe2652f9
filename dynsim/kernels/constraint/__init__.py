"""Constraint rows: points on surfaces, joints coupled to joints, and the forces of both."""
