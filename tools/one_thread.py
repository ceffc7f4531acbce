"""Numerical libraries in one thread, which they look up when numpy is imported: tools import this before all else.

The matrices are small, and tools work in several processes: more threads only wait for each other.
"""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
