"""The parts of a servo run, made from its options."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tactip_twin.assets import MESHES, MODELS
from tactip_twin.control.estimator import Estimator, ImageEstimator, LabelFunction, NetworkEstimator, Oracle
from tactip_twin.control.options import ServoOptions, Settings
from tactip_twin.control.routes import EdgePath, Geodesic, PlanarPath, Route, serpentine
from tactip_twin.control.score import surface_targets
from tactip_twin.control.servo import DEPTHS_MM, FREE_AXES, Controller, Servo, gains_named
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.model import Model, load_network
from tactip_twin.sim.contact.fidelity import Motion, fidelity_named
from tactip_twin.sim.fast_tip.sliding_tip import read_sliding_tip, shipped_sliding_tip
from tactip_twin.sim.ground_truth import EdgeGroundTruth, SurfaceGroundTruth
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact
from tactip_twin.sim.robot.arm_models import ArmModel, arm_model_named
from tactip_twin.sim.robot.fast_mounted_tip import FastMountedTip
from tactip_twin.sim.robot.mounted_tip import MountedTip, TipOnArm, clear_pose
from tactip_twin.sim.robot.objects import SceneObject, load_object
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.presets import load_design
from tactip_twin.tactip_model.renderer import RendererName

UP = np.array([0.0, 0, 1])
"""Direction from which routes over a surface are projected: from above the table."""

_START_GAP_MM = 2.5
"""Distance from the object at which a run starts, mm."""

_MAX_SEARCH_MM = 50.0
"""Limit of Settings.search_mm."""

_FORCE_EXPONENT = 1.75
"""The force of a press on a plane grows with about this power of the depth, - [?]."""

_SHIPPED_DESIGN = "tactip-127"
"""Design that the shipped networks were trained for."""


@dataclass(frozen=True)
class ServoSetup:
    """The parts of a servo run."""

    design: Design
    """Sensor, with the options' friction and stiffness."""
    scene_object: SceneObject
    """Object to follow."""
    truth: SurfaceGroundTruth | EdgeGroundTruth
    """Ground truth on the object."""
    mounted_tip: TipOnArm
    """Tip on its arm model."""
    labels: Labels
    """Components of the label and the ranges in which estimates are trusted."""
    estimator: Estimator
    """Estimator of the label."""
    network: Model | None
    """The network, if it is the estimator."""
    controller: Controller
    """Controller of the sensor's pose."""
    depth_mm: float
    """Depth to keep, mm."""
    settings: Settings
    """Settings of the follower, with forces for that depth."""
    T_start: np.ndarray
    """(4, 4), first pose of the sensor."""
    route: Route
    """Route to follow."""
    targets: np.ndarray
    """(m, 3), target points in the base frame, m."""


def prepare(
    options: ServoOptions,
    log: Callable[[str], None],
    estimator: Estimator | LabelFunction | None = None,
    controller: Controller | None = None,
) -> ServoSetup:
    """Build the parts of a servo run.

    Args:
        options: Options of the run.
        log: Callback for messages to the user.
        estimator: Replacement for the options' network.
        controller: Replacement for the paper's controller.

    Raises:
        TactipError: The options are invalid or contradict each other.
    """
    lookup("task", options.task, dict.fromkeys(DEPTHS_MM))
    if options.video and options.renderer == "raster":
        raise TactipError("--video needs OpenGL, but --renderer raster works without: leave one of them out")
    if controller is not None and not isinstance(controller, Controller):
        what = "the methods move, reset and limited_to, which a subclass of tactip_twin.Controller has"
        raise TactipError(f"the controller must have {what}, got a {type(controller).__name__}")
    scene_object = load_object(options.object, options.unit, options.scale, options.position_mm, options.rotation_deg)
    for note in (scene_object.summary, *scene_object.notes):
        log(f"{options.object}: {note}")
    design = _with_overrides(load_design(options.design), options)
    arm_model = arm_model_named(options.arm)
    gains = gains_named(options.gains, options.task)
    truth = _ground_truth(options, scene_object)
    model = load_network(_network_name(options, needed=estimator is None))
    if model.labels.task != options.task:
        raise TactipError(
            f"the network {options.network} was trained for the task {model.labels.task}, but --task is {options.task}: "
            "choose another --model"
        )
    chosen = _estimator(estimator, options, model, design, truth, scene_object)
    mounted_tip = _mounted_tip(options, design, scene_object, arm_model, truth)
    depth_mm = _depth_mm(options, model.labels)
    T_start, route, targets = _plan(options, scene_object, truth)
    T_wanted, T_start = T_start, clear_pose(mounted_tip, T_start)
    back_mm = 1e3 * float(np.linalg.norm(T_start[:3, 3] - T_wanted[:3, 3]))
    network = model if isinstance(chosen, NetworkEstimator) else None
    controller = Servo(gains, depth_mm, FREE_AXES[options.task]) if controller is None else controller
    return ServoSetup(
        design,
        scene_object,
        truth,
        mounted_tip,
        model.labels,
        chosen,
        network,
        controller,
        depth_mm,
        _settings(options, depth_mm, back_mm),
        T_start,
        route,
        targets,
    )


def _mounted_tip(
    options: ServoOptions,
    design: Design,
    scene_object: SceneObject,
    arm_model: ArmModel,
    truth: SurfaceGroundTruth | EdgeGroundTruth,
) -> TipOnArm:
    """Return the tip of the options' fidelity on its arm model."""
    solid, T_base_object = scene_object.solid, scene_object.T_base_object
    if options.fidelity != "fast":
        if options.sliding_tip:
            raise TactipError(f"--sliding-tip is for --fidelity fast, got --fidelity {options.fidelity}")
        fidelity = fidelity_named(options.fidelity)
        settle_steps = _settle_steps(options, fidelity.motion)
        return MountedTip(design, solid, fidelity, arm_model, T_base_object, settle_steps, options.speed_scale)
    if options.settle_steps is not None or options.speed_scale != 1:
        raise TactipError(f"--settle-steps and --speed-scale are for a simulated tip, got --fidelity {options.fidelity}")
    path = options.sliding_tip or shipped_sliding_tip(options.task, options.design)
    tip = read_sliding_tip(path)
    if tip.task != options.task:
        raise TactipError(f"the learned tip in {path} is for {tip.task}, got --task {options.task}")
    return FastMountedTip(tip, design, solid, fidelity_named("standard"), arm_model, T_base_object, truth)


def _estimator(
    given: Estimator | LabelFunction | None,
    options: ServoOptions,
    model: Model,
    design: Design,
    truth: SurfaceGroundTruth | EdgeGroundTruth,
    scene_object: SceneObject,
) -> Estimator:
    """Return the user's estimator, the ground truth or the network."""
    if isinstance(given, Estimator):
        return given
    if given is not None:
        return ImageEstimator(given, model.labels.components, design, _renderer(options), options.noise_grey)
    if options.model == "oracle":
        return Oracle(truth, scene_object.T_base_object)
    image = dataclasses.replace(design.image, size_px=model.size)
    return NetworkEstimator(model, dataclasses.replace(design, image=image), _renderer(options), options.noise_grey)


def _network_name(options: ServoOptions, needed: bool) -> str:
    """Return name or folder of the network; if none is needed, of a shipped one that has the task's label ranges."""
    if options.model not in ("", "oracle") or (MODELS / options.network).is_dir():
        return options.network
    if options.model == "oracle" or not needed:
        return dataclasses.replace(options, design=_SHIPPED_DESIGN).network
    raise TactipError(f"no {options.task} network is shipped for the design {options.design!r}: choose one with --model")


def _with_overrides(design: Design, options: ServoOptions) -> Design:
    """Return the design with the friction and stiffness of the options."""
    m = design.materials
    friction = m.friction if options.friction is None else options.friction
    materials = dataclasses.replace(
        m,
        friction=friction,
        skin_young_pa=options.stiffness * m.skin_young_pa,
        gel_young_pa=options.stiffness * m.gel_young_pa,
    )
    return dataclasses.replace(design, materials=materials)


def _settle_steps(options: ServoOptions, motion: Motion) -> int:
    """Return the number of time steps at rest before an image.

    Along an edge it is half as many as on a surface, which is faster at a small cost in accuracy [M] (docs/servo.md).
    """
    if options.settle_steps is not None:
        return options.settle_steps
    return motion.pause_steps if options.task == "surface" else -(-motion.pause_steps // 2)


def _depth_mm(options: ServoOptions, labels: Labels) -> float:
    """Return the depth to keep, mm, which must be in the range of the network's labels."""
    depth_mm = DEPTHS_MM[options.task] if options.depth_mm is None else options.depth_mm
    k = labels.names.index("pose_z")
    low, high = -labels.high[k], -labels.low[k]
    if not low <= depth_mm <= high:
        raise TactipError(
            f"--depth-mm must be between {low:g} and {high:g}, got {depth_mm:g}: the network {options.network} was trained "
            "on these depths only"
        )
    return depth_mm


def _settings(options: ServoOptions, depth_mm: float, back_mm: float) -> Settings:
    """Return the options' settings of the follower, with limits of the force that rise with the depth, and a search for
    contact that is longer by what the start was moved back."""
    factor = max(1.0, depth_mm / DEPTHS_MM[options.task]) ** _FORCE_EXPONENT
    s = options.settings
    search_mm = max(s.search_mm, min(_MAX_SEARCH_MM, s.search_mm + back_mm))
    return dataclasses.replace(
        s, max_force_n=factor * s.max_force_n, ease_force_n=factor * s.ease_force_n, search_mm=search_mm
    )


def _ground_truth(options: ServoOptions, scene_object: SceneObject) -> SurfaceGroundTruth | EdgeGroundTruth:
    """Return the ground truth of the task on the object."""
    if options.task == "surface":
        return SurfaceGroundTruth(scene_object.solid)
    if scene_object.edge is None:
        names = [path.name.removesuffix(".edge.csv") for path in sorted(MESHES.glob("*.edge.csv"))]
        raise TactipError(
            f"the edge of {scene_object.name} is unknown: the edge task needs one of {', '.join(names)}, "
            f"or a mesh file with its edge beside it, in {scene_object.name}.edge.csv"
        )
    return EdgeGroundTruth(scene_object.edge)


def _plan(
    options: ServoOptions, scene_object: SceneObject, truth: SurfaceGroundTruth | EdgeGroundTruth
) -> tuple[np.ndarray, Route, np.ndarray]:
    """Return the first pose (4, 4), the route, and the target points (m, 3), base frame, m."""
    r, T, edge = options.route, scene_object.T_base_object, scene_object.edge
    if options.task == "edge" and edge is not None:
        first = edge.points[round(r.start_fraction * (len(edge.points) - 1))]
        route = EdgePath(r.reverse, r.max_length_mm / 1e3, options.settings.step_mm / 1e3)
        return _start(options, scene_object, truth, first), route, edge.points @ T[:3, :3].T + T[:3, 3]
    corners = _corners(options, scene_object)
    targets = surface_targets(scene_object, corners, UP)
    T_start = _start(options, scene_object, truth, _above(scene_object, corners[0]))
    if r.kind != "geodesic":
        return T_start, PlanarPath(corners, UP), targets
    heading = T_start[:3, :3].T @ (corners[1] - corners[0])
    return T_start, Geodesic(float(np.arctan2(heading[1], heading[0])), r.length_mm / 1e3), targets


def _corners(options: ServoOptions, scene_object: SceneObject) -> np.ndarray:
    """Return the corners (n, 3), m, of the line over a surface."""
    r = options.route
    middle = np.array([*(scene_object.middle_m[:2] if r.middle_mm is None else np.array(r.middle_mm) / 1e3), 0.0])
    heading = np.radians(r.heading_deg)
    along, across = np.array([np.cos(heading), np.sin(heading), 0]), np.array([-np.sin(heading), np.cos(heading), 0])
    width = r.width_mm / 1e3 if r.kind == "serpentine" else 0.0
    return serpentine(middle, along, across, r.length_mm / 1e3, width, r.spacing_mm / 1e3)


def _above(scene_object: SceneObject, corner: np.ndarray) -> np.ndarray:
    """Return the point (3,) of the object, in its own frame, below a corner (3,) of the line."""
    T = scene_object.T_base_object
    hit = scene_object.solid.first_hit((inverse(T) @ [*corner[:2], 2.0, 1])[:3], inverse(T)[:3, :3] @ -UP)
    if not np.isfinite(hit):
        ends = scene_object.solid.vertices @ T[:2, :3].T + T[:2, 3]
        low, high = (1e3 * f(ends, axis=0) for f in (np.min, np.max))
        raise TactipError(
            f"the route must begin above the object, got {1e3 * corner[0]:.0f}, {1e3 * corner[1]:.0f} mm: the object lies "
            f"within x {low[0]:.0f} to {high[0]:.0f}, y {low[1]:.0f} to {high[1]:.0f} mm; choose a smaller "
            "--route.length-mm and --route.width-mm, or another --route.middle-mm"
        )
    return (inverse(T) @ [*corner[:2], 2.0 - hit, 1])[:3]


def _start(
    options: ServoOptions, scene_object: SceneObject, truth: SurfaceGroundTruth | EdgeGroundTruth, place: np.ndarray
) -> np.ndarray:
    """Return the first pose (4, 4), above a place (3,) on the object, with a random error if a seed is given."""
    T_object_sensor = np.eye(4)
    T_object_sensor[:3, :3] = np.linalg.inv(scene_object.T_base_object)[:3, :3] @ np.diag([-1.0, 1, -1])
    T_object_sensor[:3, 3] = place
    off = np.array([0, 0, _START_GAP_MM, 0, 0, 0])
    if options.seed is not None:
        rng = np.random.default_rng(options.seed)
        off = off + rng.uniform([-3, -3, 0, -8, -8, -8], [3, 3, 3, 8, 8, 8])
    return scene_object.T_base_object @ truth.frame(T_object_sensor) @ sensor_in_contact(from_mm_deg(off))


def _renderer(options: ServoOptions) -> RendererName:
    """Return the renderer of the pins."""
    if options.renderer == "auto":
        return "raster" if options.fidelity == "fast" else "pyrender"
    return options.renderer
