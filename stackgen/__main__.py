"""`python -m stackgen`."""

import sys

from stackgen.cli import main

if __name__ == "__main__":
    sys.exit(main())
