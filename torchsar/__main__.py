"""`python -m torchsar` is the command `torchsar`."""

import sys

from torchsar.cli import main

sys.exit(main())
