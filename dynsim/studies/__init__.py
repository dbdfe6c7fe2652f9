"""Studies of several runs: variants, batches and sweeps, in processes or on a cluster."""
