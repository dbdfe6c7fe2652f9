"""Translation of descriptions to tables and references: model, contacts, loads, postures, equilibrium, scene."""
