"""Inputs by area: each module has the name of its area, its order in the golden file, and tables of rows."""
