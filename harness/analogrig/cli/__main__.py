"""``python -m analogrig.cli``, where the command is not on the PATH."""

import sys

from analogrig.cli import main

sys.exit(main())
