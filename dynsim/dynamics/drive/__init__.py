"""Drives of joints, one file per kind: ``dc``, ``servo``, ``torque``; ``law`` selects among them for the kernels.

The laws themselves are plain scalar functions of (table of parameters, row, reference, state). ``law`` hands the very
same source to the compiler. The virtual servos call it without numba, and tests with complex numbers, whose imaginary
parts are derivatives: so comparisons look at real parts, and nothing here imports more than column names.
"""
