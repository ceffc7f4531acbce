"""The measurements with their weights: their solution, parts of it, its evidence, and alternatives to it."""
