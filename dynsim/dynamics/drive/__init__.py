"""Drives of joints, one file per kind: ``dc``, ``servo``, ``torque``; ``law`` selects among them for the kernels.

The laws are plain scalar functions of (table of parameters, row, reference, state), which ``law`` compiles unchanged.
Virtual servos call them without numba; tests call them with complex numbers (complex-step derivatives). Therefore their
comparisons use real parts, and the files of the kinds import only column names and ``limit``.
"""
