"""Controllers, one file each: ``Config``, ``build(config, context)``, and ``ENGINE``, the engine for its plants."""
