"""Paths of a mobile base, one file each: ``Config`` for the scenario and ``build(config, context) -> BasePath``."""
