"""Compiled equations of motion: tables, trees of bodies, drives, contacts, energy ledger, inverse kinematics."""
