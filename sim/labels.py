"""Names that sets and commands go by: tasks, components of a pose, the columns of labels. Nothing heavy is imported here."""

TASKS = ("surface", "edge")
"""The paper's two, and so the stimuli of its data sets."""

COMPONENTS = ("x", "y", "z", "Rx", "Ry", "Rz")
"""A pose's components in data sets, in the order of sim/pose.py; mm and degrees there, m and rad inside."""

LEARNED = {"surface": ("z", "Rx", "Ry"), "edge": ("x", "z", "Rx", "Ry", "Rz")}
"""Components of a pose that are learned, by task [P]."""

LABELS = tuple(f"pose_{c}" for c in COMPONENTS)
"""Columns of the pose, mm and degrees."""

SHEARS = tuple(f"shear_{c}" for c in COMPONENTS)
"""Columns of the motion in contact that led to it."""
