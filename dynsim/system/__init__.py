"""Files, YAML input, signals, standard streams, terminal, shipped scenarios, and memoisation."""
