"""Geometry of the robots and surfaces in a record, for figures, films and pages."""
