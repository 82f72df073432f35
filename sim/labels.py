"""Names in data sets and commands: tasks, fidelities, components of a pose, columns of labels. Imports nothing heavy."""

from typing import Literal, get_args

Task = Literal["surface", "edge"]
"""Name of a task of the paper, which is also the stimulus of its data sets."""

TASKS: tuple[Task, ...] = ("surface", "edge")
"""The paper's tasks [P]. A seed's samples depend on their order."""

FidelityName = Literal["draft", "standard", "reference"]
"""Name of a preset of sim/contact/fidelity.py."""

LearnedFidelityName = Literal["fast", "corrected"]
"""Name of a way to predict the contacts of `standard` (sim/fast_tip): by the learned tip alone, or corrected."""

LEARNED_FIDELITIES: tuple[str, ...] = get_args(LearnedFidelityName)
"""These names."""

COMPONENTS = ("x", "y", "z", "Rx", "Ry", "Rz")
"""Components of a pose in data sets, in the order of sim/pose.py; mm and degrees there, m and rad in the code."""

LEARNED = {"surface": ("z", "Rx", "Ry"), "edge": ("x", "z", "Rx", "Ry", "Rz")}
"""Learned components of the pose by task [P]."""

LABELS = tuple(f"pose_{c}" for c in COMPONENTS)
"""Columns of the pose, mm and degrees."""

SHEARS = tuple(f"shear_{c}" for c in COMPONENTS)
"""Columns of the motion in contact before the pose, mm and degrees."""
