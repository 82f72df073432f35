"""What comes with the package and is not code."""

from pathlib import Path

MODELS = Path(__file__).parent / "models"
"""Folder of the shipped networks, a folder each (learning/model.py, benchmarks/shipped.py)."""
