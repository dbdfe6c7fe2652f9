"""Contact surfaces, one file each: ``Config`` for the scenario and ``build(config, context) -> Quadric``."""
