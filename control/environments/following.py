"""EdgeFollow and SurfaceFollow: keep depth, position and angle along an edge or over a surface."""

from abc import abstractmethod
from typing import Any

import numpy as np

from tactip_twin.control.environments.environment import Failure, TouchEnvironment
from tactip_twin.control.environments.options import FollowOptions
from tactip_twin.control.estimator import NetworkEstimator
from tactip_twin.control.servo import DEPTHS_MM, reference_mm_deg
from tactip_twin.learning.model import load_network
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.tip_state import TipState
from tactip_twin.sim.fast_tip.sliding_tip import SlidingTip, read_sliding_tip, shipped_sliding_tip
from tactip_twin.sim.ground_truth import EdgeGroundTruth, SurfaceGroundTruth
from tactip_twin.sim.labels import COMPONENTS, LEARNED, Task
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact, to_mm_deg
from tactip_twin.sim.robot.arm_models import arm_model_named
from tactip_twin.sim.robot.fast_mounted_tip import FastMountedTip
from tactip_twin.sim.robot.mounted_tip import MountedTip, TipOnArm
from tactip_twin.sim.robot.objects import SceneObject, load_object
from tactip_twin.sim.robot.recording import RecordedScene
from tactip_twin.sim.view.geometry import ColoredMesh, SceneGeometry
from tactip_twin.tactip_model.errors import TactipError

_OBJECTS: dict[Task, tuple[str, ...]] = {
    "edge": ("rim-round", "rim-square", "rim-uneven"),
    "surface": ("sphere", "saddle"),
}
"""Default objects."""

_GAP_MM = 3.0
"""Height of the tip above the object before it is pressed on, mm."""

_REACHED_M = 3e-3
"""Distance to a goal that counts as reached, m."""

_MIDDLE_M = 10e-3
"""Largest distance of a path's middle from that of the object's face along x and y, m."""

_MAX_DEPTH_ERROR_MM, _MAX_LATERAL_MM, _MAX_TILT_DEG, _MAX_YAW_DEG = 3.0, 6.0, 25.0, 45.0
"""Errors that end an episode: beyond them the networks and the learned tip do not know the contact."""

_COST = np.array([0.5, 0.5, 0.5, 0.1, 0.1, 0.1])
"""Cost of an error by component, per mm and per degree [?]."""


class _Follow(TouchEnvironment):
    """An environment that follows an object."""

    task: Task

    def __init__(self, render_mode: str | None = None, **options: Any) -> None:
        """Args:
            render_mode: None, rgb_array, or human: a page in the browser.
            **options: See FollowOptions.

        Raises:
            TactipError: An option is invalid.
        """
        try:
            follow = FollowOptions(**options)
        except TypeError as error:
            raise TactipError(f"unknown option: {error}") from error
        self._names = tuple(follow.objects) or _OBJECTS[self.task]
        self._depth_mm = DEPTHS_MM[self.task] if follow.depth_mm is None else follow.depth_mm
        self._follow = follow
        self._rows = [COMPONENTS.index(c) for c in LEARNED[self.task]]
        super().__init__(follow, "T" + "".join(LEARNED[self.task]), len(self._rows), render_mode)

    def _kept(self) -> set[str]:
        return super()._kept() | {"_names", "_depth_mm", "_follow", "_rows"}

    def _forget(self) -> None:
        super()._forget()
        self._tips: dict[str, tuple[SceneObject, EdgeGroundTruth | SurfaceGroundTruth, TipOnArm]] = {}
        self._learned: SlidingTip | None = None
        self._network: NetworkEstimator | None = None
        self._geometry: SceneGeometry | None = None
        self._static: list[ColoredMesh] = []

    @property
    def tip(self) -> TipOnArm:
        """The tip on the episode's object."""
        return self._parts[2]

    def _load(self, name: str) -> tuple[SceneObject, EdgeGroundTruth | SurfaceGroundTruth, TipOnArm]:
        """Return an object, its ground truth and the tip on it, which are kept."""
        if name not in self._tips:
            scene_object = load_object(name)
            edge = scene_object.edge if self.task == "edge" else None
            truth = SurfaceGroundTruth(scene_object.solid) if edge is None else EdgeGroundTruth(edge)
            arm, T = arm_model_named(self.options.arm), scene_object.T_base_object
            if self.options.fidelity == "fast":
                if self._learned is None:
                    self._learned = read_sliding_tip(shipped_sliding_tip(self.task, self.options.design))
                standard = fidelity_named("standard")
                tip = FastMountedTip(self._learned, self.design, scene_object.solid, standard, arm, T, truth)
            else:
                tip = MountedTip(self.design, scene_object.solid, fidelity_named(self.options.fidelity), arm, T)
            self._tips[name] = scene_object, truth, tip
        return self._tips[name]

    def _start(self) -> TipState:
        rng, f = self.np_random, self._follow
        self._parts = self._load(self._names[int(rng.integers(len(self._names)))])
        scene_object, truth, tip = self._parts
        T_object_sensor = np.eye(4)
        T_object_sensor[:3, :3] = inverse(scene_object.T_base_object)[:3, :3] @ np.diag([-1.0, 1, -1])
        T_object_sensor[:3, 3] = self._sample_path()
        T_base_contact = scene_object.T_base_object @ truth.frame(T_object_sensor)
        label = reference_mm_deg(self._depth_mm)
        size = np.where(np.arange(6) < 3, f.start_mm, f.start_deg) * np.isin(np.arange(6), self.movement.axes)
        label[self._rows] += (rng.uniform(-1, 1, 6) * size)[self._rows]
        above = label.copy()
        above[2] = _GAP_MM
        T_above = T_base_contact @ sensor_in_contact(from_mm_deg(above))
        if tip.gap(T_above) < 0:
            raise Failure("the tip has no room above its start")
        tip.reset_to(T_above)
        state = tip.go(T_base_contact @ sensor_in_contact(from_mm_deg(label)))
        self._geometry = None
        self._progress_m = 0.0
        self._before = tip.arm_model.pose
        self._update()
        self._begin_route()
        return state

    @abstractmethod
    def _sample_path(self) -> np.ndarray:
        """Sample a path on the present object; return its first point (3,), m, object's frame. Raises Failure."""

    @abstractmethod
    def _begin_route(self) -> None:
        """Prepare the route from the present pose."""

    @abstractmethod
    def _advance(self) -> float:
        """Return the progress along the route, m, of the last motion."""

    @abstractmethod
    def _goal(self) -> np.ndarray:
        """Return the goal (3,), m, base frame."""

    def _update(self) -> None:
        """Compute the true label at the present pose."""
        scene_object, truth, tip = self._parts
        self._label = truth.label(inverse(scene_object.T_base_object) @ tip.arm_model.pose)

    @property
    def error_mm_deg(self) -> np.ndarray:
        """The true label minus the one to keep (6,), mm and degrees."""
        return to_mm_deg(self._label) - reference_mm_deg(self._depth_mm)

    def _state(self, estimated: bool) -> np.ndarray:
        if not estimated:
            return self.error_mm_deg[self._rows]
        if self._network is None:
            name = {"surface": "surface-curved", "edge": "edge"}[self.task]
            model = load_network(f"{name}-{self.options.design}")
            self._network = NetworkEstimator(model, self.design, self.options.renderer)
        label = self._network.estimate(self.touch, self.tip.arm_model.pose).label
        return (to_mm_deg(label) - reference_mm_deg(self._depth_mm))[self._rows]

    def _feature_count(self) -> int:
        return 0 if self.movement.forward else 3

    def _features(self) -> np.ndarray:
        if self.movement.forward:
            return np.zeros(0)
        return 1e3 * (inverse(self.tip.arm_model.measured_pose()) @ [*self._goal(), 1])[:3]

    def _outcome(self) -> tuple[float, bool]:
        self._update()
        error = np.abs(self.error_mm_deg)
        tilt = float(np.linalg.norm(error[3:5]))
        limits = (error[2], _MAX_DEPTH_ERROR_MM, "mm from its depth"), (tilt, _MAX_TILT_DEG, "degrees from its normal")
        across = (error[0], _MAX_LATERAL_MM, "mm beside the edge"), (error[5], _MAX_YAW_DEG, "degrees from its direction")
        for value, limit, what in limits + (across if self.task == "edge" else ()):
            if not value <= limit:
                raise Failure(f"the sensor is {value:.1f} {what} (at most {limit:g})")
        advance = self._advance()
        self._progress_m += advance
        self._before = self.tip.arm_model.pose
        cost = min(1.0, float((_COST * error)[self._rows].sum()))
        reached = self._progress_m >= self._follow.length_mm / 1e3 - (0 if self.movement.forward else _REACHED_M)
        return 1e3 * advance / self.options.step_mm - cost, reached

    def _info(self) -> dict[str, Any]:
        return {
            "object": self._parts[0].name,
            "error_mm_deg": self.error_mm_deg,
            "progress_mm": 1e3 * self._progress_m,
        }

    def _meshes(self) -> tuple[list[ColoredMesh], list[ColoredMesh], np.ndarray]:
        scene_object, _, tip = self._parts
        if self._geometry is None:
            solid, radius = scene_object.solid, self.design.shape.radius_m
            with_arm = self.options.arm != "none"
            self._geometry = SceneGeometry(
                RecordedScene(
                    solid.vertices, solid.triangles, scene_object.T_base_object, tip.mesh.triangles, radius, with_arm
                )
            )
            self._static = [self._geometry.object.transformed(scene_object.T_base_object), self._geometry.table]
        pose = tip.arm_model.pose
        moving = self._geometry.moving_meshes(tip.arm_model.angles, pose, self.touch.skin)
        return self._static, moving, pose[:3, 3]


class EdgeFollow(_Follow):
    """Follow the edge of an object, anticlockwise as seen from above.

    Without T in the movement mode, the action must also move along the edge, towards the goal on it.
    """

    task: Task = "edge"

    def _sample_path(self) -> np.ndarray:
        edge = self._parts[0].edge
        if edge is None:
            raise TactipError(f"the edge of {self._parts[0].name} is unknown: choose one of {', '.join(_OBJECTS['edge'])}")
        self._edge, self._edge_truth = edge, EdgeGroundTruth(edge)
        self._distances = np.concatenate([[0], np.linalg.norm(np.diff(edge.points, axis=0), axis=1).cumsum()])
        length = self._distances[-1]
        room = length if edge.closed else length - self._follow.length_mm / 1e3
        if room <= 0:
            raise Failure(f"the edge of {self._parts[0].name} is shorter than {self._follow.length_mm:g} mm")
        return self._point(self.np_random.uniform(0, room))

    def _point(self, distance: float) -> np.ndarray:
        """Return the point (3,), m, object's frame, at a distance along the edge, m."""
        return np.array([np.interp(distance, self._distances, c) for c in self._edge.points.T])

    def _along(self, T_base_sensor: np.ndarray) -> float:
        """Return the distance along the edge, m, of a sensor (4, 4)."""
        return self._edge_truth.nearest((inverse(self._parts[0].T_base_object) @ T_base_sensor)[:3, 3])[0]

    def _begin_route(self) -> None:
        self._first = self._along(self._before)

    def _goal(self) -> np.ndarray:
        distance = (self._first + self._follow.length_mm / 1e3) % self._distances[-1]
        return (self._parts[0].T_base_object @ [*self._point(distance), 1])[:3]

    def _forward(self) -> np.ndarray:
        return np.array([0.0, -1.0, 0.0])  # y of the contact frame, if the sensor is aligned with the edge

    def _advance(self) -> float:
        length = self._distances[-1]
        step = self._along(self.tip.arm_model.pose) - self._along(self._before)
        return float(step - length * np.round(step / length))


class SurfaceFollow(_Follow):
    """Follow a surface straight on, in a direction that is sampled.

    Without T in the movement mode, the action must also move along the surface, towards a goal on it.
    """

    task: Task = "surface"

    def _sample_path(self) -> np.ndarray:
        rng, scene_object = self.np_random, self._parts[0]
        angle, half = rng.uniform(-np.pi, np.pi), self._follow.length_mm / 2e3
        heading = np.array([np.cos(angle), np.sin(angle), 0.0])
        middle = scene_object.middle_m + np.append(rng.uniform(-_MIDDLE_M, _MIDDLE_M, 2), 0)
        self._heading = heading
        self._end = self._below(middle + half * heading)
        return (inverse(scene_object.T_base_object) @ [*self._below(middle - half * heading), 1])[:3]

    def _below(self, place: np.ndarray) -> np.ndarray:
        """Return the point (3,) of the object below a place (3,), m, base frame. Raises Failure if there is none."""
        scene_object = self._parts[0]
        T, start = inverse(scene_object.T_base_object), np.array([*place[:2], 2.0])
        hit = scene_object.solid.first_hit((T @ [*start, 1])[:3], T[:3, :3] @ [0, 0, -1.0])
        if not np.isfinite(hit):
            raise Failure(f"the path leaves {scene_object.name}")
        return start - [0, 0, hit]

    def _begin_route(self) -> None:
        heading = self._before[:3, :3].T @ self._heading
        heading[2] = 0.0
        self._in_sensor = heading / np.linalg.norm(heading)

    def _goal(self) -> np.ndarray:
        return self._end

    def _forward(self) -> np.ndarray:
        return self._in_sensor

    def _advance(self) -> float:
        here, before = self.tip.arm_model.pose, self._before
        if self.movement.forward:
            return float((here[:3, 3] - before[:3, 3]) @ (before[:3, :3] @ self._in_sensor))
        left = [np.linalg.norm(T[:3, 3] - self._end) for T in (before, here)]
        return float(left[0] - left[1])
