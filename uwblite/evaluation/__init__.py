"""Errors of a result against truth: trajectory, anchors, map."""
