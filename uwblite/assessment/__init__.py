"""Assessment of a finished estimate: its summary, warnings and doubts."""
