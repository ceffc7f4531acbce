"""The stages that ``mapping.py`` calls, from a recording to its final graph and grid."""
