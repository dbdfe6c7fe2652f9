"""Virtual servos: their registers and motion, the serial line, scripted faults, and the plant that the servos drive."""
