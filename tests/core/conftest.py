"""One thread for numpy: the oracles solve small systems, and threads that wait for each other make that slow."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, when numpy is loaded
