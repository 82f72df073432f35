"""A servo run from its options to its folder: recording, score and figure."""

import dataclasses
import json
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np

from tactip_twin.control.estimator import Estimator, LabelFunction
from tactip_twin.control.follow import ContourFollower, Event
from tactip_twin.control.options import ServoOptions
from tactip_twin.control.score import score
from tactip_twin.control.sensed_tip import Step
from tactip_twin.control.servo import Controller, reference_mm_deg
from tactip_twin.control.servo_setup import ServoSetup, prepare
from tactip_twin.control.surface_score import surface_score
from tactip_twin.control.trajectory_figure import write_figure
from tactip_twin.learning.pose_filter import PoseFilter
from tactip_twin.sim.pose import inverse
from tactip_twin.sim.robot.recording import RecordedScene, Recorder, RecordingFullError
from tactip_twin.sim.view.replay_video import render_frames
from tactip_twin.sim.view.video import write_video
from tactip_twin.tactip_model.errors import Interrupted
from tactip_twin.tactip_model.files import write_file

SCORE, FIGURE, FILM = "score.json", "figure.png", "film.mp4"


def run_servo(
    options: ServoOptions,
    progress: Callable[[Step], None] = lambda step: None,
    log: Callable[[str], None] = print,
    estimator: Estimator | LabelFunction | None = None,
    controller: Controller | None = None,
) -> dict[str, Any]:
    """Follow an object, and write recording, score and figure to `options.out`.

    Args:
        options: Options of the run.
        progress: Called with each step.
        log: Callback for messages to the user.
        estimator: An object with the method `estimate`, or a function from the tactile image to the label in mm and degrees,
            in place of the network. Estimates outside the label ranges of the task's network still count as failures.
        controller: A `Controller`, in place of the paper's.

    Returns:
        The score, as JSON values.

    Raises:
        TactipError: The options are invalid or contradict each other.
        Interrupted: On Ctrl-C; the steps so far are recorded and scored.
    """
    setup = prepare(options, log, estimator, controller)
    scenery = _scenery(options, setup)
    recorder = Recorder(options.out, _description(options, setup), scenery, (SCORE, FIGURE, FILM))
    to_object = inverse(setup.scene_object.T_base_object)

    def record(step: Step) -> None:
        label = setup.truth.label(to_object @ step.T_base_tcp)
        recorder.add(_row(step, label, setup.scene_object.T_base_object))
        progress(step)

    def note(event: Event) -> None:
        recorder.note(dataclasses.asdict(event))

    follower = ContourFollower(
        setup.mounted_tip,
        setup.estimator,
        setup.controller,
        setup.labels,
        setup.settings,
        record,
        time.perf_counter,
        note,
        PoseFilter(options.task, options.filter) if options.filter.enabled else None,
    )
    interrupted = False
    try:
        follower.run(setup.T_start, setup.route)
    except KeyboardInterrupt:
        interrupted, follower.stopped_because = True, "interrupted by Ctrl-C"
    except RecordingFullError as full:
        follower.stopped_because = str(full)
    outcome = {
        "closed": setup.route.closed,
        "stopped_because": follower.stopped_because,
        "peak_force_n": follower.peak_force_n,
        "left_out": [dataclasses.asdict(stretch) for stretch in follower.left_out],
        "warnings": setup.mounted_tip.warnings,
    }
    finished, arrays = recorder.results(outcome)
    try:
        figures = score(arrays, finished, reference_mm_deg(setup.depth_mm), setup.targets)
        if options.task == "surface":
            radius_m = setup.design.shape.radius_m
            figures |= surface_score(arrays, setup.scene_object, setup.targets, setup.depth_mm, radius_m)
        write_file(options.out / SCORE, (json.dumps(figures, indent=1) + "\n").encode())
        if options.renderer != "raster":
            left_out = [np.array(stretch.places_m) for stretch in follower.left_out]
            reference = reference_mm_deg(setup.depth_mm)
            write_figure(options.out / FIGURE, scenery, arrays, options.task, reference, left_out=left_out)
        if options.video and not interrupted and finished["steps"]:
            write_video(options.out / FILM, render_frames(scenery, finished, arrays))
    finally:
        # Last, so after a kill the same command works; but an error or Ctrl-C completes it.
        recorder.finish(outcome)
    if interrupted:
        raise Interrupted(f"the steps so far are in {options.out}")
    return figures


def _description(options: ServoOptions, setup: ServoSetup) -> dict[str, Any]:
    """Return the settings of a run for its recording, as JSON values."""
    chosen = dataclasses.asdict(options)
    for name in ("out", "json"):  # they do not change what is recorded
        chosen.pop(name, None)
    return {
        "task": options.task,
        "object": setup.scene_object.name,
        "options": json.loads(json.dumps(chosen, default=str)),
        "design": json.loads(json.dumps(dataclasses.asdict(setup.design))),
        "estimator": type(setup.estimator).__name__,
        "controller": type(setup.controller).__name__,
        "network": None if setup.network is None else setup.network.provenance,
        "versions": {p: version(p) for p in ("mujoco", "numpy", "torch", "mink", "libigl")},
    }


def _scenery(options: ServoOptions, setup: ServoSetup) -> RecordedScene:
    """Return the scene of a run for its recording."""
    return RecordedScene(
        setup.scene_object.solid.vertices,
        setup.scene_object.solid.triangles,
        setup.scene_object.T_base_object,
        setup.mounted_tip.mesh.triangles,
        setup.design.shape.radius_m,
        options.arm != "none",
    )


def _row(step: Step, label: np.ndarray, T_base_object: np.ndarray) -> dict[str, Any]:
    """Return a row of recording.ARRAYS from a step, its true label (6,), m and rad, and the object's pose (4, 4)."""
    return {
        "T_base_tcp": step.T_base_tcp,
        "T_base_tcp_measured": step.T_base_tcp_measured,
        "T_base_object": T_base_object,
        "angles_rad": step.angles,
        "pin_tips_m": step.touch.pin_tips,
        "directions": step.touch.directions,
        "skin_m": step.touch.skin,
        "force_n": step.touch.force,
        "predicted": step.estimate.label,
        "predicted_from_image": step.label_from_image,
        "deviations": np.full(6, np.nan) if step.estimate.deviations is None else step.estimate.deviations,
        "true": label,
        "touching": step.estimate.touching,
        "penetration_m": step.touch.penetration_m,
        "phase": step.phase,
        "part": step.part,
        "sim_steps": step.touch.steps,
        "seconds": list(step.seconds.values()),
        "images": step.estimate.image,
    }
