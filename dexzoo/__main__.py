"""`python -m dexzoo`."""

import sys

from dexzoo.cli.main import main

sys.exit(main())
