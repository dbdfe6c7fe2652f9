"""Handling of files, YAML input, signals, standard streams, the terminal and shipped scenarios, and memoisation."""
