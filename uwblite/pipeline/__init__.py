"""The stages that ``mapping.py`` names, in the order of a recording's way through them."""
