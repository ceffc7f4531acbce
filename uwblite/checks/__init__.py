"""Findings about a recording before it is mapped: ``uwblite check``."""
