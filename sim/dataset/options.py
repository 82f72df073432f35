"""Options that a data set's configuration and the command line share. Light to import, for the command line."""

from dataclasses import dataclass

from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, Ranges
from tactip_twin.tactip_model.renderer import RendererName


@dataclass(frozen=True)
class DatasetOptions:
    """Size, seed, randomization and renderer of a data set."""

    samples: int = 200
    """Number of samples of each set: contacts times symmetries times images per contact; the paper has 2000."""
    seed: int = 0
    """Seed of the set; each contact spawns its own random generator from it."""
    renderer: RendererName = "pyrender"
    """Renderer of the pins; raster renders the same image without OpenGL."""
    augment_symmetry: bool = False
    """Make a sample for every symmetry of each contact: 8 per contact on the surface, 2 on the edge."""
    curvature_per_m: tuple[float, float] = (0.0, 0.0)
    """Range of both principal curvatures of the surface, 1/m, sampled for each contact: positive is convex, 0 is flat.
    Curvature is not a label."""
    varying_curvature_fraction: float = 0.0
    """Fraction of the contacts, 0 to 1, whose curvature varies along the surface within its range."""
    rough_fraction: float = 0.0
    """Fraction of the contacts, 0 to 1, on surfaces with ridges, bumps, hollows, folds and steps that are smaller than the
    tip, on a base of half the curvature."""
    shard_samples: int = 10_000
    """Maximum number of samples per shard: a larger set is a folder of shards, which every command reads as one set."""
    snapshots_per_contact: int = 1
    """Number of images per contact: one at its pose, then one after each stride of a sliding path, as in servoing. An image
    costs less than a contact."""
    keep_mesh: bool = False
    """Also keep the deformed mesh of every contact, in mesh.npz: after its approach, and at each of its images. The learned
    tip is taught on such sets."""
    pose: Ranges = POSE_RANGES["surface"]
    """Ranges of the labelled poses, low and high of each component. On the command line, the defaults are those of the task
    in the paper (Table 1)."""
    shear: Ranges = SHEAR_RANGES
    """Ranges of the unlabelled shears, low and high of each component. The defaults are the paper's (Table 1)."""
