"""Options of the measurements of servo runs and policies. Light to import, for the command line."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tactip_twin.sim.labels import FidelityName

ServoGroup = Literal["objects", "oracle", "arm", "fidelity", "robust", "filter", "starts"]
"""Groups of servo runs (benchmarks/servo/servo.py)."""

ReinforcementLearningPart = Literal["edge", "surface", "fidelities"]
"""Parts of the page of reinforcement learning (benchmarks/servo/reinforcement_learning.py)."""


@dataclass(frozen=True)
class ServoBenchOptions:
    """Measure the accuracy of the servo by object, arm and fidelity, and its robustness. Rerun to resume."""

    groups: tuple[ServoGroup, ...] = ()
    """Groups to measure. Default: all. Results of others remain on the page."""
    other_surface: str = ""
    """A surface network trained with another seed, to compare with the shipped one. Default: none."""
    other_edge: str = ""
    """An edge network trained with another seed. Default: none."""
    runs: Path = Path("runs/servo-bench")
    """Folder of the runs: RUNS/GROUP/NAME."""
    out: Path = Path("docs")
    """Folder for servo.json, servo.md and servo.png."""
    workers: str = "auto"
    """Number of worker processes; auto: one per core."""


@dataclass(frozen=True)
class HardObjectsOptions:
    """Follow objects with features that are smaller and more hollow than the tip, and hard rims. Rerun to resume."""

    fidelity: FidelityName | Literal["fast"] = "standard"
    """Fidelity of the contact simulation."""
    only: tuple[str, ...] = ()
    """Names of the objects. Default: all. Results of others remain on the page."""
    whole: bool = True
    """Follow the route over each object. Otherwise those results remain on the page."""
    starts: int = 0
    """Number of random starts per object, up to 50, with the learned tip."""
    meshes: Path = Path("build/hard-objects")
    """Folder for the meshes of the objects, which are made there."""
    runs: Path = Path("runs/hard-objects")
    """Folder of the runs."""
    out: Path = Path("docs")
    """Folder for hard_objects.json and hard_objects.md."""
    workers: str = "auto"
    """Number of worker processes; auto: one per core."""


@dataclass(frozen=True)
class TrackingOptions:
    """Measure how well the servo tracks a plate that moves in all axes, by fidelity, depth and rate."""

    only: tuple[str, ...] = ()
    """Names of the settings to measure. Default: all. Results of others remain on the page."""
    seconds: float = 60.0
    """Duration of each run, s: two periods of the motion."""
    runs: Path = Path("runs/tracking")
    """Folder of the runs."""
    out: Path = Path("docs")
    """Folder for tracking.json and tracking.md."""


@dataclass(frozen=True)
class ReinforcementLearningOptions:
    """Train policies in the environments, compare them with the servo, and measure each fidelity. Rerun to resume."""

    parts: tuple[ReinforcementLearningPart, ...] = ()
    """Parts to measure: tasks to train and test a policy for, and cost and error of each fidelity. Default: all. Results of
    others remain on the page."""
    steps: int = 6000
    """Number of steps of the environment of each training."""
    episodes: int = 20
    """Number of test episodes of each row."""
    fidelity_steps: int = 40
    """Number of steps that are repeated at each fidelity."""
    runs: Path = Path("runs/reinforcement-learning")
    """Folder of the trainings: RUNS/TASK."""
    out: Path = Path("docs")
    """Folder for reinforcement_learning.json, reinforcement_learning.md and reinforcement_learning.png."""
    release: Path | None = None
    """Folder that the policies are written to, as TASK-follow.npz. Default: none is written."""
