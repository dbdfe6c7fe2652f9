"""Controllers, one file each: ``Config`` for the scenario and ``build``."""
