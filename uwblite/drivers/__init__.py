"""Devices of the robot: bytes in, events out, and the recorder that writes them to a log.

Reading order: ``events`` (what a driver says), ``scip``, ``dwm1001``, ``dwm1001_shell``, ``kobuki`` and
``odometry_line`` (bytes to events, no port, no clock), ``clock`` (device time to host time), the ``*_session`` modules
(what to send next), ``transport`` (the only file that knows serial ports), ``log_file`` and ``recorder``.
Nothing here needs numpy: a recording computer may do without it.
"""
