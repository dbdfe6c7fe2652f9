"""Motors, one file per parameter set or kind: a ``Config`` with the defaults of its source, and ``build``."""
