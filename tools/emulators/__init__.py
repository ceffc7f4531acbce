"""Emulated devices that speak the real protocols: a URG-04LX, a DWM1001 and a Kobuki.

``world`` is what they measure (a recording played back, or a built-in room), ``scip_device``, ``dwm_device`` and
``kobuki_device`` answer bytes with bytes at a given time and touch no port, ``faults`` damages what they say, ``wires``
connects them to pseudo-terminals and TCP ports. The command is ``tools/emulate.py``.
"""
