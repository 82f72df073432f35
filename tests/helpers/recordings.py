"""A short made-up recording, for tests of replay and export."""

from functools import cache

import numpy as np

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim.robot.irb120 import READY_RAD, Arm
from tactip_twin.sim.robot.objects import load_object
from tactip_twin.sim.robot.recording import PHASES, RecordedScene
from tactip_twin.tactip_model.mesh import build_mesh
from tactip_twin.tactip_model.presets import load_design


def tip_mesh():
    return build_mesh(load_design("tactip-127").shape, fidelity_named("draft").mesh)


@cache
def sphere():
    return load_object("sphere")


def scenery(with_arm=True):
    scene_object = sphere()
    triangles = tip_mesh().triangles
    return RecordedScene(
        scene_object.solid.vertices, scene_object.solid.triangles, scene_object.T_base_object, triangles, 20e-3, with_arm
    )


STEPS, SIZE_PX = 12, 32


def arrays_of(task="edge"):
    """Return the arrays of a recording in which the tip moves along x by a millimetre per step, and the object along y."""
    mesh, T = tip_mesh(), Arm().forward(READY_RAD)
    poses = np.repeat(T[None], STEPS, 0)
    poses[:, 0, 3] += 1e-3 * np.arange(STEPS)
    object_poses = np.repeat(sphere().T_base_object[None], STEPS, 0)
    object_poses[:, 1, 3] += 1e-3 * np.arange(STEPS)
    rng = np.random.default_rng(0)
    skin = np.repeat(mesh.vertices[None, : mesh.surface_count], STEPS, 0) + 1e-4 * np.arange(STEPS)[:, None, None]
    return {
        "T_base_tcp": poses,
        "T_base_object": object_poses,
        "angles_rad": READY_RAD + 0.01 * np.arange(STEPS)[:, None],
        "skin_m": skin.astype(np.float32),
        "pin_tips_m": rng.normal(size=(STEPS, 5, 3)),
        "directions": np.repeat([[[0.0, 0, -1]]], STEPS, 0).repeat(5, 1),
        "predicted": np.repeat(from_mm_deg([0, 0, -3, 0, 0, 0])[None], STEPS, 0),
        "deviations": np.repeat(from_mm_deg([0, 0, 0.2, 1, 1, 0])[None], STEPS, 0),
        "true": np.repeat(from_mm_deg([0, 0, -2.9, 0, 0, 0])[None], STEPS, 0),
        "phase": np.array([0, 0, *[PHASES.index("follow")] * (STEPS - 2)], np.uint8),
        "part": np.zeros(STEPS, int),
        "force_n": np.ones((STEPS, 3)),
        "penetration_m": np.zeros(STEPS),
        "seconds": np.full((STEPS, 4), 0.01),
        "images": 255 * rng.integers(0, 2, (STEPS, SIZE_PX, SIZE_PX)).astype(np.uint8),
    }


RECORD = {
    "task": "edge",
    "object": "sphere",
    "steps": STEPS,
    "size_px": SIZE_PX,
    "events": [{"step": 7, "kind": "force", "what": "9.0 N on the tip"}],
    "stopped_because": "the loop is closed",
}
