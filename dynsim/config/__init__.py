"""Base classes of configurations, messages of validation errors, and shell completion."""
