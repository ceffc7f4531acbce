"""A simulated robot in a simulated building: the recording a real one would make, and the truth beside it.

It shares no code with uwblite on purpose: a sign error common to both would go unseen. Poses are (..., 3) arrays of
x, y, theta; metres, radians, seconds. Every random draw comes from one seeded generator, so a seed names a recording.

Reading order: floorplans, drive, wheels, laser, radio, recording, logfile.
"""
