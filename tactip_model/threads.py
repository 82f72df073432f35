"""How the threads of numerical libraries wait for each other.

Values of GOMP_SPINCOUNT and OMP_WAIT_POLICY that the user has set stay as they are.
"""

import os

SPIN_COUNT = "1000"
"""Number of spins of a waiting OpenMP thread before it sleeps. GNU's OpenMP spins for some milliseconds by default, so two
jobs on the same cores spin for threads that are not running, and each trains at a twentieth of its speed alone. With this
number each keeps half its speed, and training alone is 4 % slower (docs/performance.md).
"""


def choose_waiting() -> None:
    """Let waiting OpenMP threads sleep soon, unless the user has set their behaviour. Call this before importing a library
    that uses OpenMP."""
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPIN_COUNT)
