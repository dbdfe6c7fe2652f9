"""Plants, one file each: ``Config``, ``build(config, context)``, and ``ENGINE``, the engine that simulates it."""
