"""Motors, one file per kind or parameter set: a ``Config`` with defaults from its source, and ``build``."""
