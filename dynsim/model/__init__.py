"""What a machine is made of, in SI units, and its compilation to the arrays of the kernels."""
