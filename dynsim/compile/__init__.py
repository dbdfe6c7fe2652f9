"""Compilation of a description to tables of numbers: model, contacts, references, surfaces."""
