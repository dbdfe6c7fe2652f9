"""Services of the operating system: files, YAML, signals, streams, terminal; and memoisation."""
