"""Benchmarks: time and accuracy of right-hand side and whole runs, compared with Pinocchio and MuJoCo.

All programs get the same robot, from the same tables, and run in one thread. They run in turns, and medians of CPU time
are reported, so that other load on the machine affects all of them equally. Ratios of times depend less on the machine
than times. Further benchmarks: sweeps (wall time, several processes), and work against precision of dynsim.
"""
