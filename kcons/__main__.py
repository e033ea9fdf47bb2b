"""`python -m kcons`: the command `kcons`."""

import sys

from kcons.cli.main import main

sys.exit(main())
