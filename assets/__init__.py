"""Data files of the package."""

from pathlib import Path

MODELS = Path(__file__).parent / "models"
"""Folder of the released networks, with one folder each (learning/model.py, benchmarks/learning/release_models.py)."""

MESHES = Path(__file__).parent / "meshes"
"""Folder of the objects to follow: NAME.ply in metres, and NAME.edge.csv for an object with an edge (meshes/make.py)."""

ARM = Path(__file__).parent / "irb120" / "irb120.xml"
"""MuJoCo model of the ABB IRB 120."""

FAST_TIPS = Path(__file__).parent / "fast_tips"
"""Folder of the shipped learned tips, TASK-DESIGN.npz (sim/fast_tip)."""

POLICIES = Path(__file__).parent / "policies"
"""Folder of the shipped policies, TASK-follow.npz (control/policy.py, benchmarks/servo/reinforcement_learning.py)."""
