"""Devices of the robot: bytes in, events out, and the recorder that writes them to a log.

Reading order: ``events`` (what a driver reports), ``framing`` (bytes to frames), ``..clocks`` (device time to host time),
``session`` (a protocol and its script), one device, for example ``kobuki``; ``devices`` (the table), ``transport`` (the
only file that knows serial ports), ``log_file`` and ``recorder``.
Nothing here needs numpy: a recording computer may do without it.
"""
