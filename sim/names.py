"""Names that sets and commands go by: tasks, and the columns of labels. Nothing heavy is imported here."""

TASKS = ("surface", "edge")
"""The paper's two, and so the stimuli of its data sets."""

_COMPONENTS = ("x", "y", "z", "Rx", "Ry", "Rz")

LABELS = tuple(f"pose_{c}" for c in _COMPONENTS)
"""Columns of the pose, mm and degrees; components as sim/pose.py has them."""

SHEARS = tuple(f"shear_{c}" for c in _COMPONENTS)
"""Columns of the motion in contact that led to it."""
