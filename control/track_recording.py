"""The recording of a tracking run: the steps of a tip that follows a moving object (sim/robot/recording.py)."""

import dataclasses
import json
from importlib.metadata import version

import numpy as np

from tactip_twin.control.estimator import Estimate
from tactip_twin.control.track_options import TrackOptions
from tactip_twin.sim.contact.tip_state import TipState
from tactip_twin.sim.robot.moving_object import TipOnMovingObject
from tactip_twin.sim.robot.objects import SceneObject
from tactip_twin.sim.robot.recording import RecordedScene, Recorder
from tactip_twin.tactip_model.design import Design


class TrackRecorder:
    """Records the steps of a tracking run in the folder of its results."""

    def __init__(
        self,
        options: TrackOptions,
        design: Design,
        scene_object: SceneObject,
        tip: TipOnMovingObject,
        beside: tuple[str, ...],
    ) -> None:
        """Start the recording.

        Args:
            options: Options of the run.
            design: Design of the sensor.
            scene_object: The object, at the start.
            tip: The tip.
            beside: Names of the other files of the run (recording.Recorder).

        Raises:
            TactipError: The folder is not empty.
        """
        chosen = dataclasses.asdict(options)
        for name in ("out", "json"):  # they do not change what is recorded
            chosen.pop(name, None)
        solid, self._tip = scene_object.solid, tip
        scene = RecordedScene(
            solid.vertices,
            solid.triangles,
            scene_object.T_base_object,
            tip.mesh.triangles,
            design.shape.radius_m,
            options.arm != "none",
        )
        description = {
            "task": "surface",
            "object": scene_object.name,
            "options": json.loads(json.dumps(chosen, default=str)),
            "design": json.loads(json.dumps(dataclasses.asdict(design))),
            "versions": {p: version(p) for p in ("mujoco", "numpy", "torch", "mink", "libigl")},
        }
        self._recorder = Recorder(options.out, description, scene, beside)

    def add(self, phase: str, touch: TipState, estimate: Estimate, true: np.ndarray, simulation_s: float) -> None:
        """Add the present step.

        Args:
            phase: One of recording.PHASES.
            touch: State of the tip.
            estimate: Estimate of the label, with the shear in the components that a surface does not define.
            true: (6,), m and rad, the pose relative to the place of the object that was touched first.
            simulation_s: Time for the simulation, s.
        """
        arm = self._tip.arm_model
        self._recorder.add({
            "T_base_tcp": arm.pose,
            "T_base_tcp_measured": arm.measured_pose(),
            "T_base_object": self._tip.T_base_object,
            "angles_rad": arm.angles,
            "pin_tips_m": touch.pin_tips,
            "directions": touch.directions,
            "skin_m": touch.skin,
            "force_n": touch.force,
            "predicted": estimate.label,
            "predicted_from_image": estimate.label,
            "deviations": np.full(6, np.nan),
            "true": true,
            "touching": estimate.touching,
            "penetration_m": touch.penetration_m,
            "phase": phase,
            "part": 0,
            "sim_steps": touch.steps,
            "seconds": [simulation_s, estimate.image_s, estimate.network_s, 0.0],
            "images": estimate.image,
        })  # fmt: skip

    def finish(self, stopped_because: str) -> None:
        """Complete the recording with why the run stopped."""
        self._recorder.finish({"stopped_because": stopped_because, "closed": False})
