"""Motion of Dynamixel servos: replay of a record, live drive, checks, calibration, comparison, and virtual servos.

This package does not depend on how a record was made. Only ``virtual.simulated_plant`` uses the simulation.
"""
