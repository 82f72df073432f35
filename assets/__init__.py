"""What comes with the package and is not code."""

from pathlib import Path

MODELS = Path(__file__).parent / "models"
"""Folder of the shipped networks, a folder each (learning/model.py, benchmarks/learning/release_models.py)."""

MESHES = Path(__file__).parent / "meshes"
"""Folder of the things to follow: NAME.ply in metres, and NAME.edge.csv where there is an edge (meshes/make.py)."""

ARM = Path(__file__).parent / "irb120" / "irb120.xml"
"""The ABB IRB 120."""
