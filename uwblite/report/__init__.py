"""A result for people: HTML page, picture, canvas and font."""
