"""Replay of records on servos, and live drives: check, verification, motion, end state, measured record, comparison."""
