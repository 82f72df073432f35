"""An independent finite-element code for linear tetrahedra: large strain, statics, any law given as a stress.

It shares only the mesh with the simulator. Newton's method works on the assembled forces, whose derivatives by complex steps
are exact (Squire & Trapp 1998).
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import spsolve

LAWS = ("stable neo-Hooke", "St Venant-Kirchhoff", "split neo-Hooke")

_TINY = 1e-30


def lame(young: float, poisson: float) -> tuple[float, float]:
    """Return Lamé's constants lambda and mu, Pa, for Young's modulus (Pa) and Poisson's ratio."""
    mu = young / (2 * (1 + poisson))
    return 2 * mu * poisson / (1 - 2 * poisson), mu


def piola(law: str, young: float, poisson: float, gradient: np.ndarray) -> np.ndarray:
    """Return the first Piola-Kirchhoff stress (..., 3, 3), Pa.

    The energies of the laws are:

    - `stable neo-Hooke`: mu/2 (tr C - 3) - mu (J - 1) + (lambda + mu)/2 (J - 1)^2, which is that of Smith, de Goes & Kim
      2018 without its logarithm, with lambda chosen for Hooke's law at small strains.
    - `St Venant-Kirchhoff`: mu E:E + lambda/2 tr(E)^2.
    - `split neo-Hooke`, as in CalculiX: mu/2 (J^(-2/3) tr C - 3) + K/2 (J - 1)^2.

    Args:
        law: One of LAWS.
        young: Young's modulus, Pa.
        poisson: Poisson's ratio, -.
        gradient: (..., 3, 3) deformation gradients.
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

    def __init__(self, vertices: ArrayLike, tetrahedra: ArrayLike, law: str, young: float, poisson: float) -> None:
        """Prepare the elements.

        Args:
            vertices: (n, 3), m.
            tetrahedra: (m, 4) int, of positive volume.
            law: One of LAWS.
            young: Young's modulus, Pa.
            poisson: Poisson's ratio, -.
        """
        self.vertices, self.tetrahedra = np.asarray(vertices, float), np.asarray(tetrahedra)
        self.material = law, young, poisson
        edges = self.vertices[self.tetrahedra[:, 1:]] - self.vertices[self.tetrahedra[:, :1]]
        inner = np.swapaxes(np.linalg.inv(edges), 1, 2)
        # Gradients (m, 4, 3) of the four shape functions; edges are rows.
        self._slopes = np.concatenate([-inner.sum(1, keepdims=True), inner], 1)
        self._volumes = np.linalg.det(edges) / 6
        self._freedoms = (3 * self.tetrahedra[..., None] + np.arange(3)).reshape(len(self.tetrahedra), 12)

    def _gradients(self, displacements: np.ndarray) -> np.ndarray:
        return np.eye(3) + np.einsum("eki,ekj->eij", displacements[self.tetrahedra], self._slopes)

    def forces(self, displacements: np.ndarray) -> np.ndarray:
        """Return the elastic forces (n, 3), N, of the vertices on their supports at displacements (n, 3), m."""
        stress = piola(*self.material, self._gradients(displacements))
        force = np.einsum("eij,ekj,e->eki", stress, self._slopes, self._volumes)
        total = np.zeros(displacements.size)
        np.add.at(total, self._freedoms, force.reshape(-1, 12))
        return total.reshape(-1, 3)

    def _stiffness(self, displacements: np.ndarray) -> csr_array:
        gradient = self._gradients(displacements).astype(complex)
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
        return coo_array((local.ravel(), (rows, columns)), (displacements.size, displacements.size)).tocsr()

    def solve(self, fixed: np.ndarray, prescribed: np.ndarray, steps: int = 8) -> np.ndarray:
        """Return the displacements (n, 3), m, at rest.

        Args:
            fixed: (n, 3) bool, the coordinates whose displacement is prescribed.
            prescribed: (n, 3), m; only its fixed coordinates count.
            steps: Number of equal steps in which the prescribed displacements are reached.

        Raises:
            ArithmeticError: Newton's method does not converge.
        """
        moved, free = np.zeros(self.vertices.shape), np.flatnonzero(~fixed.ravel())
        for step in range(1, steps + 1):
            move = np.where(fixed, prescribed * step / steps - moved, 0.0).ravel()
            for _ in range(30):
                stiffness = self._stiffness(moved)
                residual = -self.forces(moved).ravel() - stiffness @ move
                move[free] = np.asarray(spsolve(stiffness[free][:, free].tocsc(), residual[free]))
                moved = moved + move.reshape(-1, 3)
                if np.abs(move).max() < 1e-12:
                    break
                move = np.zeros(moved.size)
            else:
                raise ArithmeticError("the tetrahedra did not converge")
        return moved
