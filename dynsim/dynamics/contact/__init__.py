"""Contacts: geometry, constraint rows, contact laws, and the solvers for contact and brace forces."""
