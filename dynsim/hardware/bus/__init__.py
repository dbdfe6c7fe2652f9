"""The servo bus: its interface, packets, control tables, clocks, port scan, and implementation on a serial port."""
