"""Choice of how the threads of numerics wait for each other.

Values of GOMP_SPINCOUNT and OMP_WAIT_POLICY that the user has set stay as they are.
"""

import os

SPIN_COUNT = "1000"
"""Number of times that a waiting OpenMP thread looks again before it sleeps.

By default GNU's OpenMP spins for some milliseconds, and two jobs on the same cores then spin for threads that are not
running: each trains at a twentieth of its speed alone. With this number it is a half, and training alone is 4 % slower;
threads that sleep at once make it a third slower (docs/performance.md, `tactip bench performance --groups shared-cores`).
"""


def choose_waiting() -> None:
    """Let OpenMP threads sleep soon unless the user has chosen. Call this before a library that uses OpenMP is imported."""
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPIN_COUNT)
