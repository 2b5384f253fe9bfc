"""`python -m skin_host` is `skin`."""

import sys

from skin_host.cli import main

if __name__ == "__main__":
    sys.exit(main())
