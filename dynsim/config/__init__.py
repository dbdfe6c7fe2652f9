"""Base classes for configurations, messages for validation errors, and shell completion."""
