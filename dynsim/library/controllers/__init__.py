"""Controllers, one file each: ``Config``, ``build(config, context)``, and ``ENGINE`` of the plants it controls."""
