"""Contradictions within a recording before it is mapped: units, breaks of the odometry, sensors that stand still.

`screen` is what both `uwblite map` and `uwblite check` call. What can be repaired is repaired and reported; what cannot is
a doubt, and readings of a unit that is plainly wrong are refused by name.
"""
