"""Contact surfaces, one file each: ``Config``, and ``build``, which gives a ``Quadric``, ``Box`` or ``HeightField``."""
