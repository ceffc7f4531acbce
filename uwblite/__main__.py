"""``python -m uwblite``: the same as the ``uwblite`` command."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
