"""Files in, files out: text to types and back, no algorithm."""
