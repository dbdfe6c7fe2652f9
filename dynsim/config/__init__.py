"""Base of configurations, and their problems in words."""
