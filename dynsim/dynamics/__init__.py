"""Compiled mechanics: tables, trees of bodies, drives, contacts, and the derivative of the state."""
