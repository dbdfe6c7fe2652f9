"""Pictures of records: figures, films and pages."""
