"""Measures of what the system finds, against the truth."""
