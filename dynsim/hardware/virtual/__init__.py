"""Virtual servos: registers and motion, serial line, scripted faults, and the mechanics they move."""
