"""Clocks that are not ours.

A message that a sensor stamps at d, by a clock of its own, arrives at ``h = offset + (1 + skew) d + delay`` by the receiver's.
The delay is never negative and often near its least; the skew is a crystal's; counts have a resolution and wrap. A reset
changes the offset, but not the delay, a property of the link. Receivers are the host of a recording (`device_clock`) and the
odometry of a robot that is localised (`sensor_clock`); offset, skew and jitter of both come from one estimator (`clock_map`).
"""
