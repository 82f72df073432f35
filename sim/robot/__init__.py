"""The arm, the tip mounted on it, the objects it follows, and recordings of runs."""
