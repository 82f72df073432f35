"""A servo run from its options to its folder: recording, score and picture."""

import dataclasses
import json
import time
from importlib.metadata import version

import numpy as np

from tactip_twin.assets import MESHES, MODELS
from tactip_twin.control.estimator import NetworkEstimator, Oracle
from tactip_twin.control.follow import ContourFollower
from tactip_twin.control.routes import EdgePath, Geodesic, PlanarPath, serpentine
from tactip_twin.control.score import score, surface_targets
from tactip_twin.control.servo import DEPTHS_MM, Servo, gains_named, reference_mm_deg
from tactip_twin.control.trajectory_figure import write_figure
from tactip_twin.learning.model import find_model
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.ground_truth import EdgeGroundTruth, SurfaceGroundTruth
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact
from tactip_twin.sim.robot.arm_models import arm_model_named
from tactip_twin.sim.robot.mounted_tip import MountedTip
from tactip_twin.sim.robot.objects import load_object
from tactip_twin.sim.robot.recording import RecordedScene, Recorder
from tactip_twin.sim.view.replay_video import render_frames
from tactip_twin.sim.view.video import write_video
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import Interrupted, TactipError, lookup
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.presets import find_design

SCORE, FIGURE, FILM = "score.json", "figure.png", "film.mp4"

UP = np.array([0.0, 0, 1])
"""From where routes over a surface are seen: above the table."""


def run(options, progress=lambda step: None, say=print, estimator=None):
    """Run a servo. options: Options. progress: called with each explore.Step. say: called with lines for the user.
    estimator: an Estimator in the place of the network, whose ranges of labels are kept to all the same.

    Writes recording, score and picture. Returns the score (dict). Raises TactipError on what cannot be done, and
    Interrupted at
    Ctrl-C; what was recorded by then is kept, scored and drawn.
    """
    lookup("task", options.task, dict.fromkeys(("surface", "edge")))
    if options.film and options.renderer != "pyrender":
        raise TactipError(f"a film is drawn by pyrender: --film does not go with --renderer {options.renderer}")
    thing = load_object(options.object, options.unit, options.scale, options.place_mm, options.turn_deg)
    for repair in thing.notes:
        say(f"{options.object}: {repair}")
    design = _as_asked(find_design(options.design), options)
    fidelity, carrier = fidelity_named(options.fidelity), arm_model_named(options.arm)
    gains = gains_named(options.gains, options.task)
    truth = _truth(options, thing)
    model = find_model(_network(options))
    if model.labels.task != options.task:
        raise TactipError(
            f"the network {options.network} was trained for the {model.labels.task}, not for the {options.task}"
        )
    if estimator is None and options.model == "oracle":
        estimator = Oracle(truth, thing.T_base_object)
    elif estimator is None:
        estimator = NetworkEstimator(model, design, options.renderer, options.noise_grey)
    rest_steps = _rest_steps(options, fidelity.motion)
    finger = MountedTip(design, thing.solid, fidelity, carrier, thing.T_base_object, rest_steps, options.pace)
    depth_mm = _depth_mm(options, model.labels)
    servo = Servo(gains, depth_mm)
    T_start, route, targets = _plan(options, thing, truth)
    description = {
        "task": options.task,
        "object": thing.name,
        "options": json.loads(json.dumps(dataclasses.asdict(options), default=str)),
        "estimator": type(estimator).__name__,
        "network": model.provenance if isinstance(estimator, NetworkEstimator) else None,
        "versions": {p: version(p) for p in ("mujoco", "numpy", "torch", "mink", "libigl")},
    }
    scenery = RecordedScene(
        thing.solid.vertices,
        thing.solid.triangles,
        thing.T_base_object,
        finger.scene.mesh.triangles,
        design.shape.radius_m,
        options.arm != "none",
    )
    recorder = Recorder(options.out, description, scenery)
    to_object = inverse(thing.T_base_object)

    def record(step):
        recorder.add(_row(step, truth.label(to_object @ step.T_base_tcp)))
        progress(step)

    def note(event):
        recorder.note(dataclasses.asdict(event))

    explorer = ContourFollower(finger, estimator, servo, model.labels, options.settings, record, time.perf_counter, note)
    stopped = False
    try:
        explorer.run(T_start, route)
    except KeyboardInterrupt:
        stopped, explorer.stopped_because = True, "Ctrl-C"
    outcome = {
        "closed": route.closed,
        "stopped_because": explorer.stopped_because,
        "warnings": finger.warnings,
    }
    done, arrays = recorder.finish(outcome)
    figures = score(arrays, done, reference_mm_deg(depth_mm), targets)
    write_file(options.out / SCORE, (json.dumps(figures, indent=1) + "\n").encode())
    if options.renderer == "pyrender":
        write_figure(options.out / FIGURE, scenery, arrays, options.task)
    if options.film and not stopped and done["steps"]:
        write_video(options.out / FILM, render_frames(scenery, done, arrays))
    if stopped:
        raise Interrupted(f"what was recorded is in {options.out}")
    return figures


def _network(options):
    """Name or folder (str) of the network that sees, or whose labels' ranges the truth is held to."""
    if options.model not in ("", "oracle") or (MODELS / options.network).is_dir():
        return options.network
    if options.model == "oracle":
        return dataclasses.replace(options, design=_WITH_NETWORKS).network
    raise TactipError(f"no network of the {options.task} is shipped for the tip {options.design!r}: give --model")


_WITH_NETWORKS = "tactip-127"
"""Design that networks are shipped for."""


def _as_asked(design, options):
    """The Design with the friction and stiffness of the options."""
    m = design.materials
    young = {name: options.stiffness * getattr(m, name) for name in ("skin_young_pa", "gel_young_pa")}
    friction = m.friction if options.friction is None else options.friction
    return dataclasses.replace(design, materials=dataclasses.replace(m, friction=friction, **young))


def _rest_steps(options, motion):
    """Time steps at rest (int) before an image. Along an edge half as many as over a surface: a fifth more steps a second,
    for 0.02 mm of depth and 0.1 degrees [M] (docs/servo.md)."""
    if options.settle_steps is not None:
        return options.settle_steps
    return motion.pause_steps if options.task == "surface" else -(-motion.pause_steps // 2)


def _depth_mm(options, labels):
    """The depth to keep (float). labels: learning.labels.Labels of the network, whose range it must be in."""
    deep = DEPTHS_MM[options.task] if options.depth_mm is None else options.depth_mm
    k = labels.names.index("pose_z")
    least, most = -labels.high[k], -labels.low[k]
    if not least <= deep <= most:
        raise TactipError(f"--depth-mm is {deep:g}: the network {options.network} has learned {least:g} to {most:g} mm")
    return deep


def _truth(options, thing):
    if options.task == "surface":
        return SurfaceGroundTruth(thing.solid)
    if thing.edge is None:
        names = [path.name.removesuffix(".edge.csv") for path in sorted(MESHES.glob("*.edge.csv"))]
        raise TactipError(f"{thing.name} has no edge that is known: the edge task takes one of {', '.join(names)}")
    return EdgeGroundTruth(thing.edge)


def _plan(options, thing, truth):
    """Start (4, 4), Route, and places to touch (m, 3)."""
    r, step = options.route, options.settings.step_mm / 1e3
    T, corners = thing.T_base_object, None
    if options.task == "edge":
        edge = thing.edge
        k = round(r.start_share * (len(edge.points) - 1))
        place = edge.points[k]
        route = EdgePath(r.backward, r.most_mm / 1e3, step)
        targets = edge.points @ T[:3, :3].T + T[:3, 3]
    else:
        middle = np.array([*(thing.middle_m[:2] if r.middle_mm is None else np.array(r.middle_mm) / 1e3), 0.0])
        heading = np.radians(r.heading_deg)
        along, across = np.array([np.cos(heading), np.sin(heading), 0]), np.array([-np.sin(heading), np.cos(heading), 0])
        width = r.width_mm / 1e3 if r.kind == "serpentine" else 0.0
        corners = serpentine(middle, along, across, r.length_mm / 1e3, width, r.spacing_mm / 1e3)
        targets = surface_targets(thing, corners, UP)
        hit = thing.solid.first_hit((inverse(T) @ [*corners[0, :2], 2.0, 1])[:3], inverse(T)[:3, :3] @ -UP)
        require(
            np.isfinite(hit),
            "the start of the route",
            f"{1e3 * corners[0, 0]:.1f}, {1e3 * corners[0, 1]:.1f} mm",
            "above the object",
        )
        place = (inverse(T) @ [*corners[0, :2], 2.0 - hit, 1])[:3]
        route = PlanarPath(corners, UP)
    T_there = np.eye(4)
    T_there[:3, :3] = np.linalg.inv(T)[:3, :3] @ np.diag([-1.0, 1, -1])
    T_there[:3, 3] = place
    off = np.array([0, 0, _OFF_MM, 0, 0, 0])
    if options.seed is not None:
        draw = np.random.default_rng(options.seed)
        off = off + draw.uniform([-3, -3, 0, -8, -8, -8], [3, 3, 3, 8, 8, 8])
    T_start = T @ truth.frame(T_there) @ sensor_in_contact(from_mm_deg(off))
    if corners is not None and r.kind == "geodesic":
        turn = T_start[:3, :3].T @ (corners[1] - corners[0])
        route = Geodesic(float(np.arctan2(turn[1], turn[0])), r.length_mm / 1e3)
    return T_start, route, targets


_OFF_MM = 2.5
"""How far off the object a run begins, mm."""


def _row(step, label):
    """A row of tactip_twin.sim.robot.recording.ARRAYS of an explore.Step and the true label (6,)."""
    return {
        "T_base_tcp": step.T_base_tcp,
        "T_told": step.T_told,
        "angles_rad": step.angles,
        "tips_m": step.touch.tips,
        "directions": step.touch.directions,
        "skin_m": step.touch.skin,
        "force_n": step.touch.force,
        "felt": step.sight.label,
        "true": label,
        "touching": step.sight.touching,
        "penetration_m": step.touch.penetration_m,
        "phase": step.phase,
        "part": step.part,
        "sim_steps": step.touch.steps,
        "seconds": list(step.seconds.values()),
        "images": step.sight.image,
    }
