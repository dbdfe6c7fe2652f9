"""Hand paths, one file each: ``Config`` for the scenario and ``build(config, context) -> HandPath``."""
