"""Brace forces of least motor heat for a given motion, and their tables."""
