"""`python -m stackgen`."""

import sys

from stackgen.commands.cli import main

if __name__ == "__main__":
    sys.exit(main())
