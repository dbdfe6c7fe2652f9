"""Geometry of the robots and surfaces of a record, for figures, films and pages."""
