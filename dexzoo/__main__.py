"""`python -m dexzoo`."""

import sys

from dexzoo.cli import main

sys.exit(main())
