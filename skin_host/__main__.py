"""`python -m skin_host` is `skin`."""

import signal
import sys


def main() -> int:
    """Run the command line; Ctrl-C ends it without a traceback, also while it is imported."""
    try:
        from skin_host import cli

        return cli.main()
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


if __name__ == "__main__":
    sys.exit(main())
