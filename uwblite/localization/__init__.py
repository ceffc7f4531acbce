"""Where a robot is in a map that is there already, while it drives: from an unknown start, and how sure that is."""
