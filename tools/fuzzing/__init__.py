"""Damaged inputs: whole small files, ways to damage them, and who reads them."""
