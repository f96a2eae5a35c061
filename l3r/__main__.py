"""``python -m l3r`` is ``l3r``."""

import sys

from l3r.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
