"""The occupancy grid (paper: step 3): geometry, rays, binary Bayes filter."""
