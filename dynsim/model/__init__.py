"""Machines in SI units: bodies, joints, drives, surfaces, contacts; URDF import, URDF and MJCF export."""
