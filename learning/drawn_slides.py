"""Training contacts that slide on, which the sliding tip (sim/fast_tip/sliding_tip.py) draws anew at every epoch."""

from dataclasses import dataclass

import numpy as np

from tactip_twin.learning.data import Samples
from tactip_twin.learning.drawn_contacts import (
    MAX_ROUNDS,
    DrawnContacts,
    check_source,
    columns_of,
    configuration_of,
    too_few,
)
from tactip_twin.learning.tactile_raster import TactileRaster
from tactip_twin.sim.contact.curved_surface import sample_curvatures
from tactip_twin.sim.contact.rigid_points import RigidPoints
from tactip_twin.sim.contact.rough_surface import sample_rough_surface
from tactip_twin.sim.contact.signed_distance import DistanceField
from tactip_twin.sim.contact.smooth_surface import SmoothSurface
from tactip_twin.sim.contact.stimuli import stimulus_named
from tactip_twin.sim.dataset.contact_sample import sample_motion
from tactip_twin.sim.dataset.sliding import SlidingPath
from tactip_twin.sim.fast_tip.fast_tip import PinDecoder
from tactip_twin.sim.fast_tip.measures import forces_and_patch
from tactip_twin.sim.fast_tip.overlap import NEAR_M, dome_points, overlap_harmonics
from tactip_twin.sim.fast_tip.sliding_contact import DOME_GROUPS, motion_below, parts_of
from tactip_twin.sim.fast_tip.sliding_tip import SlidingTip, Steps, motion_between
from tactip_twin.sim.pose import before_shear, label_of, sensor_in_contact, shear_between, to_mm_deg


@dataclass(frozen=True)
class _Path:
    """A sliding path in steps that the tip predicts one by one. (m steps)"""

    steps: Steps
    """The steps."""
    in_contact: np.ndarray
    """(m,) bool: whether the tip is in contact after a step."""
    shears: np.ndarray
    """(m, 6) m and rad, the motion since the tip touched down."""
    is_seen: np.ndarray
    """(m,) bool: whether an image is taken after a step: at the stops whose label is in the set's ranges."""


class SlideSource:
    """Source of contacts of the kind that a set of sliding paths has: its ranges, surfaces, sensor and images."""

    def __init__(self, samples: Samples, tip: SlidingTip, device: str = "cpu") -> None:
        """Prepare the prediction and the renderer.

        Args:
            samples: Samples of a simulated set of sliding paths, on curved surfaces or not.
            tip: Sliding tip of the set's sensor.
            device: Torch device of the images.

        Raises:
            TactipError: The set's contacts have varied mechanics or press objects, its images are grey, or the tip belongs
                to another sensor or task.
        """
        self.configuration = c = configuration_of(samples)
        """Configuration of the set."""
        check_source(samples, c, tip.task)
        tip.check_design(c.design)
        self._tip, self._decoder, self._labels = tip, PinDecoder(c.design, tip.modes), samples.labels
        self._flat = stimulus_named(c.task)
        self._dome = RigidPoints(dome_points(c.design.shape.radius_m), DOME_GROUPS)
        self.raster = TactileRaster(c.design, device)
        """Renderer of the sensor's images."""

    def draw(self, count: int, rng: np.random.Generator) -> DrawnContacts:
        """Return `count` contacts.

        A path ends where its prediction cannot be trusted.

        Raises:
            TactipError: If contacts are missing after MAX_ROUNDS rounds of draws.
        """
        kept, missing = [], count
        for _ in range(MAX_ROUNDS):
            paths = -(-missing // self.configuration.snapshots_per_contact)
            drawn = self._slide([self._path(each) for each in rng.spawn(paths)])
            kept.append([a[:missing] for a in drawn])
            missing -= len(kept[-1][0])
            if not missing:
                tips, directions, targets, quantities = (np.concatenate(parts) for parts in zip(*kept, strict=True))
                return DrawnContacts(tips, directions, self.raster.render(tips, directions), targets, quantities)
        raise too_few()

    def _path(self, rng: np.random.Generator) -> _Path:
        """Return a random path: a press, the shear of a set's contact, and strides."""
        c = self.configuration
        pose, shear = sample_motion(c, rng)
        solid = self._surface(rng)
        path = SlidingPath(c.task, solid, c.pose, pose, rng)
        distance, truth = solid.distance if solid else self._flat.distance, path.truth
        start = sensor_in_contact(before_shear(pose, shear))
        places, at_stop = [start], [False]
        for k in range(c.snapshots_per_contact):
            parts = parts_of(places[-1], sensor_in_contact(path.stride() if k else pose))
            places += parts
            at_stop += [False] * (len(parts) - 1) + [True]
        # Pressed at the start: the motion before does not matter.
        before, old_gap, T_start, rows = start, np.inf, start, []
        for T, stops in zip(places, at_stop, strict=True):
            distances, label = self._dome.distances(distance, T, NEAR_M), truth.label(T)
            gap, touched = float(distances.min()), old_gap < 0
            motion = motion_between(before, T, truth.frame(T))
            motion = motion if touched else motion_below(motion, old_gap, min(gap, 0.0))
            T_start = T if gap >= 0 else T_start
            slid = shear_between(label_of(T_start), label_of(T))
            overlap, seen = overlap_harmonics(distances[None])[0], stops and c.pose.contain(label)
            rows.append((label, motion, overlap, touched, gap < 0, slid, seen))
            before, old_gap = T, gap
        labels, motions, overlaps, touched, in_contact, shears, is_seen = (np.array(a) for a in zip(*rows, strict=True))
        return _Path(Steps(labels, motions, overlaps, touched), in_contact, shears, is_seen)

    def _surface(self, rng: np.random.Generator) -> DistanceField | None:
        """Return a random surface of the set's kind; None for the flat surface and the straight edge."""
        c = self.configuration
        if c.rough_fraction and rng.uniform() < c.rough_fraction:
            return sample_rough_surface(rng, *c.curvature_per_m)
        if not c.is_curved:
            return None
        return SmoothSurface(sample_curvatures(rng, *c.curvature_per_m, c.varying_curvature_fraction))

    def _slide(self, paths: list[_Path]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return pin tips, directions, targets and quantities (DrawnContacts) of the images on paths."""
        alive = np.arange(len(paths))
        states = np.zeros((len(paths), len(self._tip.modes.orders)), np.complex64)
        seen: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
        for m in range(max(len(path.is_seen) for path in paths)):
            alive = np.array([k for k in alive if m < len(paths[k].is_seen)], int)
            moved = np.array([k for k in alive if paths[k].in_contact[m]], int)
            states[np.setdiff1d(alive, moved)] = 0
            if not len(moved):
                continue
            steps = Steps(*(
                np.stack([getattr(paths[k].steps, name)[m] for k in moved]) for name in Steps.__dataclass_fields__
            ))  # fmt: skip
            stepped = self._tip.step(steps, states[moved])
            states[moved] = stepped.states
            alive = np.setdiff1d(alive, moved[~stepped.trusted])
            good = stepped.trusted & np.array([paths[k].is_seen[m] for k in moved])
            shears = np.array([paths[k].shears[m] for k in moved])
            seen.append((stepped.states[good], stepped.measures[good], steps.poses[good], shears[good]))
        if not seen:
            seen.append((states[:0], np.zeros((0, 8)), np.zeros((0, 6)), np.zeros((0, 6))))
        states, measures, poses, shears = (np.concatenate(parts) for parts in zip(*seen, strict=True))
        measured = forces_and_patch(measures, poses)
        quantities = columns_of(shears, *(measured[name] for name in ("effective_shears", "forces_n", "slip_fractions")))
        return *self._decoder(states), self._labels.of(to_mm_deg(poses)), quantities
