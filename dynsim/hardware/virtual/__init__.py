"""Virtual servos: registers and motion, serial line, scripted faults, and the plant that they drive."""
