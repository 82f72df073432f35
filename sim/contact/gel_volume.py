"""The volume of the whole gel, kept by one row of MuJoCo's solver.

Linear tetrahedra lock near incompressibility, so they have a lower Poisson's ratio than the gel (mesh.Resolution). They
resist changes of shape as the gel does, but changes of volume too little: the tip would lose 4 % of its volume at a depth
of 5 mm, and the skin around the contact would bulge too little. The missing bulk modulus acts here on the volume of the gel
as a whole, as a pressure on the skin. A single pressure cannot lock, because it constrains one degree of freedom.
docs/mechanics.md compares force and shape with a code that does not lock.

The row is the equality constraint of two tendons over the free skin vertices, whose coefficients are set before every step
to the gradient of the volume. It is a spring that is integrated implicitly, so it is stable at any time step.
"""

import mujoco
import numpy as np
from scipy.sparse import csr_array

from tactip_twin.tactip_model.design import Materials
from tactip_twin.tactip_model.mesh import Mesh, Resolution
from tactip_twin.tactip_model.soft_body import VOLUME_ROW, VOLUME_TENDONS, missing_bulk_modulus

_IMPEDANCE = 0.5
"""Constant impedance of the row, -: at 0.5 its regularization is its inverse weight (MuJoCo's manual, "Computation")."""

_ROW = 0
"""Number of the row: MuJoCo puts equality constraints first, and the scene has no other."""


class GelVolume:
    """The row of the solver that keeps the gel's volume; its length, m, is the change of volume over the skin's area."""

    def __init__(self, model: mujoco.MjModel, mesh: Mesh, materials: Materials, resolution: Resolution) -> None:
        """Find the row of a compiled model.

        Args:
            model: Model with a soft tip that has the row (soft_body.add_soft_tip).
            mesh: Mesh of the tip.
            materials: Materials of the tip.
            resolution: Resolution of the mesh.
        """
        self._equality = model.equality(VOLUME_ROW).id
        tendons = [model.tendon(name).id for name in VOLUME_TENDONS]
        self._tendon = tendons[0]
        model.tendon_invweight0[tendons[1]] = 0.0
        first = model.tendon_adr[tendons[0]]
        self._coefficients = slice(first, first + int(model.tendon_num[tendons].sum()))
        self._triangles = mesh.triangles
        self._skin_free = ~mesh.bonded[: mesh.surface_count]
        self._inner_count = np.count_nonzero(~mesh.bonded[mesh.surface_count :])
        corners = mesh.triangles.ravel()
        facets = np.repeat(np.arange(len(mesh.triangles)), 3)
        self._at_vertices = csr_array(
            (np.full(len(corners), 1 / 6), (corners, facets)), (mesh.surface_count, len(mesh.triangles))
        )
        self._undeformed_m3, normals = self._volume_and_normals(mesh.vertices)
        self._area_m2 = float(np.linalg.norm(normals, axis=1).sum()) / 2
        bulk = missing_bulk_modulus(materials, resolution)
        self._stiffness = bulk * self._area_m2**2 / float(mesh.volumes.sum())
        self._change_m = 0.0
        self._gradient = np.zeros(0)

    def _volume_and_normals(self, vertices: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the volume (m^3) between skin and origin, and the normals (k, 3) of the facets, twice their areas long.

        The fixed base closes the skin. Its part of the volume is constant, so the volume is right up to a constant.
        """
        a, b, c = (vertices[self._triangles[:, i]] for i in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6, np.cross(b - a, c - a)

    def linearize(self, model: mujoco.MjModel, vertices: np.ndarray) -> None:
        """Set the row's coefficients and stiffness for the next step.

        Args:
            model: Model of the scene.
            vertices: (n, 3) m, deformed mesh in the sensor frame.
        """
        volume, normals = self._volume_and_normals(vertices)
        self._change_m = (volume - self._undeformed_m3) / self._area_m2
        gradient = (self._at_vertices @ normals)[self._skin_free].ravel() / self._area_m2
        model.wrap_prm[self._coefficients] = gradient
        self._gradient = gradient
        # Implicit Euler: force = -stiffness * (change + h * velocity + h^2 * acceleration). MuJoCo's row has
        # force = (reference - acceleration) / inverse weight, reference = -(solref / impedance) . (change, velocity).
        h = model.opt.timestep
        model.tendon_invweight0[self._tendon] = 1 / (self._stiffness * h**2)
        model.eq_solref[self._equality] = -_IMPEDANCE / h**2, -_IMPEDANCE / h

    def set_length(self, data: mujoco.MjData) -> None:
        """Set the row's length in a step whose positions have been computed: the tendon's own is that of a straight path."""
        data.efc_pos[_ROW] = self._change_m

    def forces(self, data: mujoco.MjData) -> np.ndarray:
        """Return the row's forces (free vertices, 3) N on the tip at the last step."""
        on_skin = data.efc_force[_ROW] * self._gradient.reshape(-1, 3)
        return np.concatenate([on_skin, np.zeros((self._inner_count, 3))])
