"""`python -m training` is the `grasp` program."""

import sys

from training.cli import main

sys.exit(main())
