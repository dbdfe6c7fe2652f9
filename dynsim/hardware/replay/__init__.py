"""Replay of a record on servos, and live drive: check, verification, motion, end, measured record, comparison."""
