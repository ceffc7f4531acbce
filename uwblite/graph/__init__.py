"""Sparse least squares over SE(2) poses, anchors and calibration: edges, solver, marginal covariances."""
