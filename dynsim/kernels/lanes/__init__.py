"""Several right-hand sides at once: a number type of N doubles, and what of the kernels needs a form of its own."""
