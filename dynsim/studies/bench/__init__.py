"""Benchmarks: time and accuracy of right-hand side and whole runs, beside Pinocchio and MuJoCo.

All contenders get the same robot, from the same tables, and run in one thread. They take turns and medians of CPU time
are reported, so that what else the machine does hits all alike; ratios carry over to other machines, times do not.
"""
