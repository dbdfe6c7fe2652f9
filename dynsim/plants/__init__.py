"""Plants, one file each: ``Config`` for the scenario, ``build``, and ``ENGINE``, which says what simulates it."""
