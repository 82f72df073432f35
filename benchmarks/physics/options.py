"""Options of the measurements of contact simulation. Light to import, for the command line."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class FidelityOptions:
    """Measure errors and costs of simulated contacts by preset and by setting. Rerun to resume."""

    out: Path = Path("docs")
    """Folder for fidelity.json, fidelity.md and fidelity.png."""
    contacts: int = 10
    """Number of contacts per task for the presets."""
    sweep_contacts: int = 5
    """Number of contacts per task for settings changed one at a time."""
    cache: Path = Path("build/fidelity")
    """Folder for the contacts simulated so far; removed at the end."""


@dataclass(frozen=True)
class StabilityOptions:
    """Map where contacts converge and where they are refused. Rerun to resume."""

    out: Path = Path("docs")
    """Folder for stability.json, stability.md and stability.png."""
    quick: bool = False
    """Measure only every seventh cell, in about a minute and a half on two cores."""
    workers: str = "auto"
    """Number of worker processes; auto: one per core."""


@dataclass(frozen=True)
class FrictionOptions:
    """Measure the force along slides, and the dependence of friction on the path."""

    out: Path = Path("docs")
    """Folder for friction.json, friction.md and friction.png."""


@dataclass(frozen=True)
class MaterialsOptions:
    """Compare the materials of gel and skin with closed-form solutions."""

    out: Path = Path("docs")
    """Folder for materials.json and materials.md."""


@dataclass(frozen=True)
class MechanicsOptions:
    """Compare the pressed tip with an independent axisymmetric finite-element code."""

    out: Path = Path("docs")
    """Folder for mechanics.json and mechanics.md."""


@dataclass(frozen=True)
class FemCrossCheckOptions:
    """Compare the pressed gel, on the same tetrahedra, with other finite-element codes."""

    out: Path = Path("docs")
    """Folder for fem_cross_check.json and fem_cross_check.md."""


@dataclass(frozen=True)
class MeshContactOptions:
    """Compare contact models of meshes by error and cost."""

    out: Path = Path("docs")
    """Folder for mesh_contact.json and mesh_contact.md."""


@dataclass(frozen=True)
class SceneCostOptions:
    """Measure the cost of each part of the data-set scene."""

    out: Path = Path("docs")
    """Folder for scene_cost.json and scene_cost.md."""
    contacts: int = 6
    """Number of contacts per task."""
