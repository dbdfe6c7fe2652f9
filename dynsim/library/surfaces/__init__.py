"""Contact surfaces, one file each: ``Config``, and ``build``, which returns a `Quadric`, `Box` or `HeightField`."""
