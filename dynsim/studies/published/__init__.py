"""Papers beside dynsim: what they state, what a run gives in its place, and what their assumptions are worth."""
