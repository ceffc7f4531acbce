"""Contradictions within a recording before it is mapped: units, breaks of the odometry, sensors that stand still.

Both `uwblite map` and `uwblite check` call `screen`. Faults that can be repaired are repaired and reported; others are
doubts, and readings in a clearly wrong unit are refused with the name of the unit.
"""
