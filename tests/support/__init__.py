"""Helpers of tests and of documented studies."""
