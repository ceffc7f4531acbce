"""UWB ranges: trilateration, bootstrap of trajectory and anchors, range noise, NLOS."""
