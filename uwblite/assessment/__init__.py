"""What a finished estimate is worth: its summary, and the warnings and doubts that it gives rise to."""
