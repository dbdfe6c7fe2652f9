"""Compilation of descriptions into kernel tables and references: model, contacts, loads, postures, statics, scene."""
