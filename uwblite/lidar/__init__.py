"""Scans as clouds and sub-maps, scan matching, joint refinement, visibility."""
