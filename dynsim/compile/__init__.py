"""Compilation of descriptions to kernel tables and references: model, contacts, loads, postures, equilibrium, scene."""
