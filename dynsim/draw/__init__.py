"""Figures, films and viewer pages of records."""
