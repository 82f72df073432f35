"""How the threads of numerical libraries wait for each other.

Values of GOMP_SPINCOUNT, OMP_WAIT_POLICY, OPENBLAS_NUM_THREADS and OMP_NUM_THREADS that the user has set stay as they are.
"""

import os

SPIN_COUNT = "1000"
"""Number of spins of a waiting OpenMP thread before it sleeps. GNU's OpenMP spins for some milliseconds by default, so two
jobs on the same cores spin for threads that are not running, and each trains at a twentieth of its speed alone. With this
number each keeps half its speed, and training alone is 4 % slower (docs/performance.md).
"""


def choose_waiting() -> None:
    """Let waiting OpenMP threads sleep soon, and numpy multiply matrices in one thread, unless the user has set their
    behaviour. Call this before importing numpy or a library that uses OpenMP.

    The threads of numpy's OpenBLAS spin, and cannot be told to sleep. The matrices that are multiplied here by the thousand
    are small: in two threads beside another job, an estimate from pins took more than 50 times as long as in one.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPIN_COUNT)
    if "OMP_NUM_THREADS" not in os.environ:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
