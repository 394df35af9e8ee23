"""``python -m seasonscapes``."""

import sys

from seasonscapes.cli import main

sys.exit(main())
