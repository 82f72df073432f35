"""Tracking of a moving object by touch: the servo keeps depth and angle, and removes the shear that the motion causes.

The label that the servo gets has the shear in the components that a surface does not define: x and y, and the rotation about
the normal. It is the pose of the sensor relative to the place that it touched, as in Lloyd & Lepora (IJRR 2024), so the same
control law follows motions in all axes. The score is the pose relative to the object, which they do not report.
"""

import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.control.estimator import Estimate, Estimator, NetworkEstimator
from tactip_twin.control.servo import Servo, gains_named, pose_error, reference_mm_deg
from tactip_twin.control.track_options import TrackOptions
from tactip_twin.control.track_recording import TrackRecorder
from tactip_twin.learning.model import Model, load_network
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.contact.tip_state import TipState
from tactip_twin.sim.dataset.format import EFFECTIVE_SHEARS
from tactip_twin.sim.fast_tip.sliding_tip import read_sliding_tip, shipped_sliding_tip
from tactip_twin.sim.ground_truth import SurfaceGroundTruth
from tactip_twin.sim.pose import from_mm_deg, inverse, label_of, sensor_in_contact, to_mm_deg
from tactip_twin.sim.robot.arm_models import arm_model_named
from tactip_twin.sim.robot.irb120 import Unreachable
from tactip_twin.sim.robot.moving_object import MovingFastTip, MovingMountedTip, TipOnMovingObject, moved_object
from tactip_twin.sim.robot.objects import SceneObject, load_object
from tactip_twin.sim.robot.recording import RecordingFullError
from tactip_twin.sim.view.plot import COLORS, figure_of, save_figure
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.presets import load_design
from tactip_twin.tactip_model.renderer import RendererName

SCORE, FIGURE = "score.json", "tracking.png"
"""Files beside the recording."""

_SHEAR_COMPONENTS = (0, 1, 5)
"""Components of the label that the shear stands for: x, y and Rz."""

_GAP_MM = 3.0
"""Height of the sensor above the object before it touches down, mm."""

_ALIGNMENT_STEPS = 15
"""Control steps in contact before the object moves, in which depth and angle are aligned."""

_TOP_M, _MAX_UNEVEN_M, _ABOVE_M = 15e-3, 0.1e-3, 2.0
"""Radius of the top that must be flat, m: the tip touches 13 mm around its apex at 4 mm depth; how much its height may vary;
and a height above every object."""


class PoseAndShearEstimator(NetworkEstimator):
    """A network's pose, with its shear in the components that a surface does not define."""

    def __init__(self, model: Model, design: Design, renderer: RendererName) -> None:
        """Prepare the network.

        Raises:
            TactipError: It does not estimate the shear, or its images have another size than the design's.
        """
        if not set(EFFECTIVE_SHEARS) <= set(model.columns):
            raise TactipError(f"the network must estimate the shear, got one that estimates {', '.join(model.columns)}")
        self._shears = [model.columns.index(name) for name in EFFECTIVE_SHEARS]
        super().__init__(model, design, renderer)

    def _estimate(self, frame: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray | None, float | None]:
        """Return what the network estimates; see ImageEstimator."""
        means, label = self._model.estimate(self._seen(frame, image)[None]).means[0], np.zeros(6)
        label[self._rows] = means[: len(self._rows)]
        label[list(_SHEAR_COMPONENTS)] = means[self._shears]
        return label, None, None


class RelativePoseOracle:
    """The true pose of the sensor relative to the place that it touched."""

    def __init__(self, tip: TipOnMovingObject, T_object_contact: np.ndarray) -> None:
        """Use the contact frame (4, 4) of the first touch."""
        self._tip, self._to_contact = tip, inverse(T_object_contact)

    def estimate(self, touch: TipState, T_base_tcp: np.ndarray) -> Estimate:
        """Return the true label."""
        return Estimate(label_of(self._to_contact @ inverse(self._tip.T_base_object) @ T_base_tcp), 1.0)


def track(options: TrackOptions, progress: Callable[[int, int], None] = lambda done, count: None) -> dict[str, Any]:
    """Track a moving object, and write recording, score and figure to `options.out`.

    Args:
        options: Options.
        progress: Called with the number of control steps made and of all.

    Returns:
        The score, as JSON values: root mean square and largest errors of the sensor's pose relative to the object.

    Raises:
        TactipError: The options are invalid, the object is not flat, or the folder is not empty.
        Interrupted: On Ctrl-C; the steps so far are recorded and scored.
    """
    run, count, stopped = _Tracking(options), round(options.seconds * options.rate_hz), "completed"
    try:
        for k in range(-_ALIGNMENT_STEPS, count):
            touched = run.step(k)
            if k >= 0:
                progress(k + 1, count)
            if not touched:
                stopped = "contact lost"
                break
    except (Unreachable, Diverged, RecordingFullError) as error:
        stopped = str(error)
    except KeyboardInterrupt:
        if not run.errors:
            raise
        stopped = "interrupted"
    errors, estimates = (np.array(rows).reshape(-1, 6) for rows in (run.errors, run.estimates))
    try:
        result = _score(errors, estimates, stopped, options)
        result |= {"options": json.loads(json.dumps(dataclasses.asdict(options), default=str))}
        _plot(errors, run.period_s, options.out / FIGURE)
        write_file(options.out / SCORE, (json.dumps(result, indent=1) + "\n").encode())
    finally:
        # Last, so after a kill the same command works; but an error or Ctrl-C completes it.
        run.recorder.finish(stopped)
    if stopped == "interrupted":
        raise Interrupted(f"recording and score of the steps so far are in {options.out}")
    return result


class _Tracking:
    """A tracking run, step by step."""

    def __init__(self, options: TrackOptions) -> None:
        """Load everything, and place the sensor above the object. Raises TactipError."""
        scene_object, design = load_object(options.object, position_mm=options.position_mm), load_design(options.design)
        self._pivot = _flat_top(scene_object)
        self._tip = tip = _tip(options, design, scene_object)
        self._motion, self._T_start = options.motion, scene_object.T_base_object
        T_base_contact = np.eye(4)
        T_base_contact[:3, :3], T_base_contact[:3, 3] = np.diag([-1.0, -1, 1]), self._pivot
        T_object_contact = inverse(self._T_start) @ T_base_contact
        self._to_contact = inverse(T_object_contact)
        self._estimator = _estimator(options, design, tip, T_object_contact)
        self.recorder = TrackRecorder(options, design, scene_object, tip, (SCORE, FIGURE))
        self.period_s = 1 / options.rate_hz
        """Time of a control step, s."""
        self._servo = Servo(gains_named(options.gains, "surface"), options.depth_mm)
        self._reference = from_mm_deg(reference_mm_deg(options.depth_mm))
        self._shears: list[np.ndarray] = []
        self.errors: list[np.ndarray] = []
        """Errors (6,), mm and degrees, of the pose relative to the object, since it moves."""
        self.estimates: list[np.ndarray] = []
        """Errors (6,), mm and degrees, of its estimates."""
        tip.reset_to(T_base_contact @ sensor_in_contact(from_mm_deg([0, 0, _GAP_MM, 0, 0, 0])))
        touch = tip.tip_state()
        estimate = self._estimator.estimate(touch, tip.arm_model.pose)
        self.recorder.add("search", touch, estimate, self._true_label(), 0.0)
        self._target = T_base_contact @ sensor_in_contact(self._reference)

    def step(self, k: int) -> bool:
        """Make control step k, counted from when the object begins to move, and return whether there is contact then.

        Raises:
            Unreachable: The arm cannot take the pose.
            Diverged: The simulation diverges.
            RecordingFullError: The recording cannot have more steps.
        """
        tip, began, rows = self._tip, time.perf_counter(), list(_SHEAR_COMPONENTS)
        touch = tip.go(self._target)
        simulation_s = time.perf_counter() - began
        estimate = self._estimator.estimate(touch, tip.arm_model.pose)
        label = estimate.label.copy()
        if k < 0:
            # The shear is zero where the tip has just touched down, so any other estimate is the network's offset.
            self._shears.append(label[rows])
            label[rows] = 0.0
        else:
            label[rows] -= np.mean(self._shears, axis=0)
        true = self._true_label()
        estimate = dataclasses.replace(estimate, label=label)
        self.recorder.add("centre" if k < 0 else "follow", touch, estimate, true, simulation_s)
        if k >= 0:
            self.errors.append(to_mm_deg(pose_error(true, self._reference)))
            self.estimates.append(to_mm_deg(label - true))
        # The object moves on while the arm moves to where the object was.
        tip.move_object(moved_object(self._T_start, self._pivot, self._motion, max(0, k + 1) * self.period_s))
        self._target = tip.arm_model.measured_pose() @ self._servo.move(label)
        return bool(np.linalg.norm(touch.force) > 0)

    def _true_label(self) -> np.ndarray:
        """Return the pose of the sensor relative to the place that it touches first, as a label (6,), m and rad."""
        return label_of(self._to_contact @ inverse(self._tip.T_base_object) @ self._tip.arm_model.pose)


def _flat_top(scene_object: SceneObject) -> np.ndarray:
    """Return the middle of an object's top (3,), m, base frame. Raises TactipError if it is not flat there."""
    T, turn = inverse(scene_object.T_base_object), np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ring = _TOP_M * np.stack([np.cos(turn), np.sin(turn)], 1)
    above = [np.append(scene_object.middle_m[:2] + place, _ABOVE_M) for place in ([0, 0], *ring)]
    heights = _ABOVE_M - np.array([scene_object.solid.first_hit((T @ [*p, 1])[:3], T[:3, :3] @ [0, 0, -1.0]) for p in above])
    if not np.ptp(heights) <= _MAX_UNEVEN_M:
        raise TactipError(
            f"the top of {scene_object.name} must be flat within {1e3 * _TOP_M:g} mm of its middle: "
            f"its height varies by {1e3 * np.ptp(heights):.1f} mm there"
        )
    return np.append(scene_object.middle_m[:2], heights[0])


def _tip(options: TrackOptions, design: Design, scene_object: SceneObject) -> TipOnMovingObject:
    """Return the tip of the options' fidelity on its arm model."""
    solid, T, arm = scene_object.solid, scene_object.T_base_object, arm_model_named(options.arm)
    if options.fidelity != "fast":
        fidelity = fidelity_named(options.fidelity)
        fidelity = dataclasses.replace(fidelity, solver=dataclasses.replace(fidelity.solver, impratio=options.impratio))
        return MovingMountedTip(design, solid, fidelity, arm, T)
    tip = read_sliding_tip(shipped_sliding_tip("surface", options.design))
    return MovingFastTip(tip, design, solid, fidelity_named("standard"), arm, T, SurfaceGroundTruth(solid))


def _estimator(options: TrackOptions, design: Design, tip: TipOnMovingObject, T_object_contact: np.ndarray) -> Estimator:
    """Return the estimator of pose and shear."""
    if options.model == "oracle":
        return RelativePoseOracle(tip, T_object_contact)
    model = load_network(options.model)
    if model.labels.task != "surface":
        raise TactipError(f"the network must be of the task surface, got one of {model.labels.task}")
    return PoseAndShearEstimator(model, design, options.renderer)


def _score(errors: np.ndarray, estimates: np.ndarray, stopped: str, options: TrackOptions) -> dict[str, Any]:
    """Return the scores of errors (n, 6), mm and degrees, of the pose and of its estimate."""
    if not len(errors):
        raise TactipError(f"nothing was tracked: {stopped}")
    distance, angle = np.linalg.norm(errors[:, :3], axis=1), np.linalg.norm(errors[:, 3:], axis=1)
    steps = max(1, round(options.motion.period_s * options.rate_hz))
    periods = range(0, len(errors), steps)
    return {
        "rms_mm": _rms(distance),
        "rms_deg": _rms(angle),
        "max_mm": float(distance.max()),
        "max_deg": float(angle.max()),
        "rms_mm_by_period": [_rms(distance[k : k + steps]) for k in periods],
        "rms_deg_by_period": [_rms(angle[k : k + steps]) for k in periods],
        "rms_by_axis": [_rms(column) for column in errors.T],
        "estimate_rms_by_axis": [_rms(column) for column in estimates.T],
        "seconds": len(errors) / options.rate_hz,
        "stopped_because": stopped,
    }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def _plot(errors: np.ndarray, period_s: float, path: Path) -> None:
    """Plot the errors (n, 6), mm and degrees, over time."""
    figure, axes = figure_of(1, 2, (9.0, 3.0))
    seconds = period_s * np.arange(len(errors))
    for axis, first, label, names in ((axes[0], 0, "error, mm", "xyz"), (axes[1], 3, "error, °", ("Rx", "Ry", "Rz"))):
        for k, name in enumerate(names):
            axis.plot(seconds, errors[:, first + k], color=COLORS[k], label=name, lw=1)
        axis.set(xlabel="time, s", ylabel=label)
        axis.legend(ncol=3)
    save_figure(figure, path)
