"""Motors, one file per parameter set: a ``Config`` with the defaults of its source, and ``build``."""
