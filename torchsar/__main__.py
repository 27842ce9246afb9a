"""`python -m torchsar` is the command `torchsar`."""

import sys

from torchsar.cli import main

if __name__ == "__main__":  # tests and tools import every module, which must not run the command
    sys.exit(main())
