"""Descriptions of machines in SI units: bodies, joints, drives, surfaces, contacts; URDF in and out, MJCF out."""
