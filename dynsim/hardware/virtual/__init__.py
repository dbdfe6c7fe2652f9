"""Servos in memory: their registers and motion, the line they hang on, scripted faults, and what they move."""
