"""An independent finite-element code for linear tetrahedra: large strain, statics, any law given as a stress.

It shares the mesh with the simulator and nothing else: Newton's method on the assembled forces, whose derivatives are
exact by complex steps (Squire & Trapp 1998).
"""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

LAWS = ("stable neo-Hooke", "St Venant-Kirchhoff", "split neo-Hooke")

_TINY = 1e-30


def lame(young, poisson):
    """Lamé's constants lambda and mu, Pa."""
    mu = young / (2 * (1 + poisson))
    return 2 * mu * poisson / (1 - 2 * poisson), mu


def piola(law, young, poisson, gradient):
    """First Piola-Kirchhoff stress (..., 3, 3), Pa, of a law at deformation gradients (..., 3, 3).

    `stable neo-Hooke`: the energy is mu/2 (tr C - 3) - mu (J - 1) + (lambda + mu)/2 (J - 1)^2: Smith, de Goes & Kim 2018
    without its logarithm, lambda taken so that small strains are Hooke's. `St Venant-Kirchhoff`: mu E:E + lambda/2 tr(E)^2.
    `split neo-Hooke`, as in CalculiX: mu/2 (J^(-2/3) tr C - 3) + K/2 (J - 1)^2.
    """
    lam, mu = lame(young, poisson)
    if law == "St Venant-Kirchhoff":
        strain = (np.swapaxes(gradient, -1, -2) @ gradient - np.eye(3)) / 2
        trace = np.trace(strain, axis1=-2, axis2=-1)[..., None, None]
        return gradient @ (2 * mu * strain + lam * trace * np.eye(3))
    j = np.linalg.det(gradient)[..., None, None]
    inverse = np.swapaxes(np.linalg.inv(gradient), -1, -2)
    if law == "stable neo-Hooke":
        return mu * gradient + ((lam + mu) * (j - 1) - mu) * j * inverse
    trace = (gradient**2).sum((-2, -1))[..., None, None]
    return mu * j ** (-2 / 3) * (gradient - trace / 3 * inverse) + (lam + 2 / 3 * mu) * (j - 1) * j * inverse


class Solid:
    """Linear tetrahedra of one material."""

    def __init__(self, vertices, tetrahedra, law, young, poisson):
        """vertices: (n, 3) m. tetrahedra: (m, 4) int, positive. law: one of LAWS. young: Pa."""
        self.vertices, self.tetrahedra = np.asarray(vertices, float), np.asarray(tetrahedra)
        self.material = law, young, poisson
        edges = self.vertices[self.tetrahedra[:, 1:]] - self.vertices[self.tetrahedra[:, :1]]
        inner = np.swapaxes(np.linalg.inv(edges), 1, 2)
        # Gradients (m, 4, 3) of the four shape functions; edges are rows.
        self._slopes = np.concatenate([-inner.sum(1, keepdims=True), inner], 1)
        self._volumes = np.linalg.det(edges) / 6
        self._freedoms = (3 * self.tetrahedra[..., None] + np.arange(3)).reshape(len(self.tetrahedra), 12)

    def _gradients(self, moved):
        return np.eye(3) + np.einsum("eki,ekj->eij", moved[self.tetrahedra], self._slopes)

    def forces(self, moved):
        """Elastic forces (n, 3), N, that the vertices, displaced by moved (n, 3) m, exert on what holds them."""
        stress = piola(*self.material, self._gradients(moved))
        force = np.einsum("eij,ekj,e->eki", stress, self._slopes, self._volumes)
        total = np.zeros(moved.size)
        np.add.at(total, self._freedoms, force.reshape(-1, 12))
        return total.reshape(-1, 3)

    def _stiffness(self, moved):
        gradient = self._gradients(moved).astype(complex)
        tangent = np.zeros((len(gradient), 3, 3, 3, 3))
        for k, m in np.ndindex(3, 3):
            step = gradient.copy()
            step[:, k, m] += 1j * _TINY
            tangent[..., k, m] = piola(*self.material, step).imag / _TINY
        slopes = self._slopes
        local = np.einsum("eijkl,eaj,ebl,e->eaibk", tangent, slopes, slopes, self._volumes, optimize=True).reshape(
            -1, 12, 12
        )
        rows, columns = np.repeat(self._freedoms, 12, 1).ravel(), np.tile(self._freedoms, (1, 12)).ravel()
        return coo_matrix((local.ravel(), (rows, columns)), (moved.size, moved.size)).tocsr()

    def solve(self, held, places, steps=8):
        """Displacements (n, 3), m, at rest. held: (n, 3) bool. places: (n, 3) m, displacements of the held coordinates.

        They are reached in `steps` equal steps. Raises ArithmeticError where Newton's method does not converge.
        """
        moved, free = np.zeros(self.vertices.shape), np.flatnonzero(~held.ravel())
        for step in range(1, steps + 1):
            move = np.where(held, places * step / steps - moved, 0.0).ravel()
            for _ in range(30):
                stiffness = self._stiffness(moved)
                residual = -self.forces(moved).ravel() - stiffness @ move
                move[free] = spsolve(stiffness[free][:, free].tocsc(), residual[free])
                moved = moved + move.reshape(-1, 3)
                if np.abs(move).max() < 1e-12:
                    break
                move = np.zeros(moved.size)
            else:
                raise ArithmeticError("the tetrahedra did not converge")
        return moved
