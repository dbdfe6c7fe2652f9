"""Parts for dynsim that are not in dynsim: a plant, a controller, a path, a surface and a motor."""
