"""URDF files: strict reading, import of robots, visual shapes, export."""
