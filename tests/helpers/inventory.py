"""Contents of a compiled scene, compared with what its job needs."""

import mujoco

from tactip_twin.sim.contact.scene import Scene

ABSENT = (
    *("nu", "nsensor", "ncam", "nlight", "ntex", "nmat", "nmocap", "nsite", "nskin", "nhfield"),
    *("nplugin", "npair", "nexclude", "nkey", "nuserdata"),
)
"""Counts of a model that must be 0 in a data-set scene."""


def inventory(scene: Scene) -> dict[str, tuple[int, int]]:
    """Return the number of each kind of item, and the number that is needed, by its name."""
    model, mesh = scene.model, scene.mesh
    free = int((~mesh.bonded).sum())
    skin = int((~mesh.bonded[: mesh.surface_count]).sum())
    hulls = len(set(model.geom_dataid[model.geom_type == mujoco.mjtGeom.mjGEOM_MESH].tolist()))
    needed = {
        "nbody": 3 + free,  # world, stimulus, tip, and one per free vertex
        "njnt": 1 + 3 * free,  # the stimulus's free joint, three slides per free vertex
        "nv": 6 + 3 * free,
        "ngeom": 1 + skin,  # the stimulus, and a sphere per free skin vertex
        "nflex": 2,  # gel and skin
        "nmesh": hulls,
        "neq": 1,  # the gel's volume
        "ntendon": 2,  # its two halves
    } | dict.fromkeys((name for name in ABSENT if hasattr(model, name)), 0)
    found = {name: (int(getattr(model, name)), count) for name, count in needed.items()}
    found["geoms of the stimulus"] = (int((model.geom_bodyid == model.body("stimulus").id).sum()), 1)
    found["geoms without contact"] = (int(((model.geom_contype | model.geom_conaffinity) == 0).sum()), 0)
    found["flexes in contact"] = (int((model.flex_contype | model.flex_conaffinity > 0).sum()), 1)
    return found
