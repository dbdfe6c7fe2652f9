"""Tools for Dynamixel servos: replay of records, live drives, checks, calibration, comparison, and virtual servos.

This package does not depend on how a record was created. Only ``virtual.simulated_plant`` uses the simulation.
"""
