"""Replay of a record on servos: check, verification, motion, measured record, comparison."""
