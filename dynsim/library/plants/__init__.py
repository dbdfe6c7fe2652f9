"""Plants, one file each: ``Config``, ``build(config, context)``, and ``ENGINE``, which says what simulates it."""
