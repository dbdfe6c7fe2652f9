"""The line to the servos: packets, control tables, what a bus can do, and the one behind a serial port."""
