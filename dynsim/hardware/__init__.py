"""Replay of a record on Dynamixel servos: offline check, verification, timed replay, and virtual servos to prove it.

Nothing here knows how a record was made; nothing here imports the simulation kernels.
"""
