"""The deformed mesh of the tip for coefficients of the skin's modes: the start of a correction (corrected_contacts.py).

The modes move the skin. The gel inside follows as a linear elastic body whose surface is moved and whose base is fixed. That
is 0.04 to 0.07 mm off in the mean [M], which the first steps of a simulation remove, since nothing holds it inside.
"""

from functools import cached_property

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from tactip_twin.sim.fast_tip.skin_field import Modes
from tactip_twin.tactip_model.mesh import Mesh


class MeshDecoder:
    """Deformed meshes for coefficients of the skin's modes: linear maps, computed once."""

    def __init__(self, mesh: Mesh, poisson: float, modes: Modes) -> None:
        """Evaluate the modes at the skin's vertices; the gel inside is factorized when it is first needed.

        Args:
            mesh: Undeformed mesh.
            poisson: Poisson's ratio of its elements, -.
            modes: Modes of the skin.
        """
        self._mesh = mesh
        count = mesh.surface_count
        outward = mesh.vertices[:count] - mesh.centre
        moved, _ = modes.at(outward / np.linalg.norm(outward, axis=1, keepdims=True))
        moved[:, mesh.bonded[:count]] = 0.0
        self._to_skin = moved.reshape(len(moved), -1)
        self._poisson = poisson

    @cached_property
    def _inside(self) -> tuple[np.ndarray, np.ndarray]:
        """The free vertices inside, and the matrix from the skin's displacements to theirs."""
        return _extension(self._mesh, self._poisson)

    def __call__(self, coefficients: np.ndarray) -> np.ndarray:
        """Return the vertices (k, n, 3), m, of deformed meshes for coefficients (k, modes) complex; sensor frame."""
        moved = self._moved(coefficients)
        vertices = np.repeat(self._mesh.vertices[None], len(moved), axis=0)
        vertices[:, : self._mesh.surface_count] += moved.reshape(len(moved), -1, 3)
        inner, to_inner = self._inside
        vertices[:, inner] += (moved @ to_inner.T).reshape(len(moved), -1, 3)
        return vertices

    def skin(self, coefficients: np.ndarray) -> np.ndarray:
        """Return the vertices (k, s, 3), m, of the skin alone for coefficients (k, modes) complex; sensor frame."""
        return self._mesh.vertices[: self._mesh.surface_count] + self._moved(coefficients).reshape(len(coefficients), -1, 3)

    def _moved(self, coefficients: np.ndarray) -> np.ndarray:
        return np.concatenate([coefficients.real, coefficients.imag], 1) @ self._to_skin


def _extension(mesh: Mesh, poisson: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the free vertices (i,) inside, and the matrix (3 i, 3 s) from the skin's displacements to theirs."""
    corners = mesh.vertices[mesh.tetrahedra]
    inverse = np.linalg.inv((corners[:, 1:] - corners[:, :1]).swapaxes(1, 2))
    # Gradients (m, 4, 3) of the linear shape functions of each tetrahedron.
    gradients = np.concatenate([-inverse.sum(1, keepdims=True), inverse], 1)
    # Hooke's law in units of the shear modulus: lambda = 2 nu / (1 - 2 nu).
    first = 2 * poisson / (1 - 2 * poisson)
    identity = np.eye(3)
    stiffness = (
        first * np.einsum("m,mai,mbj->maibj", mesh.volumes, gradients, gradients)
        + np.einsum("m,maj,mbi->maibj", mesh.volumes, gradients, gradients)
        + np.einsum("m,mak,mbk,ij->maibj", mesh.volumes, gradients, gradients, identity)
    ).reshape(-1)
    freedom = (3 * mesh.tetrahedra[:, :, None] + np.arange(3)).reshape(-1, 12)
    rows, columns = np.repeat(freedom, 12, axis=1).ravel(), np.tile(freedom, (1, 12)).ravel()
    size = 3 * len(mesh.vertices)
    whole = coo_array((stiffness, (rows, columns)), (size, size)).tocsc()
    held = mesh.bonded.copy()
    held[: mesh.surface_count] = True
    inner = np.flatnonzero(~held)
    free = (3 * inner[:, None] + np.arange(3)).ravel()
    of_skin = np.arange(3 * mesh.surface_count)
    return inner, -splu(whole[free][:, free].tocsc()).solve(whole[free][:, of_skin].toarray())
