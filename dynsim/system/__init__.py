"""Files, YAML, signals, streams, terminal, memo."""
