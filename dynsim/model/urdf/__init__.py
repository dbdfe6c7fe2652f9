"""Robots from URDF files: reading, building, writing."""
