"""Program `grasp`, as `python -m training`."""

import sys

from training.program.cli import main

sys.exit(main())
