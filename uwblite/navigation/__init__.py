"""Planning on a map: clearance from obstacles, the cheapest path over the grid, and its smoothing."""
