"""Where robots and surfaces of a record are, and what they look like: for figures, films and pages alike."""
