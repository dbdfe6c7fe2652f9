"""Motors, one file per parameter set: a ``Config`` of motor parameters with the defaults of its source."""
