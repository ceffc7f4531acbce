"""Faults of sensors and users, put into whole recordings."""
