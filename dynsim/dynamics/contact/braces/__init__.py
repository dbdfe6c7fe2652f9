"""Brace forces that minimise the motor heat for a given motion, and their tables."""
