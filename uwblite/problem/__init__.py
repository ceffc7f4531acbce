"""The measurements with their weights: their solution, parts of it, and its evidence."""
