"""Base class of configurations, and the wording of validation errors."""
