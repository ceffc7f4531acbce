"""Keyframes along the odometry and what is attached to them; edges, noise and gyro of the odometry."""
