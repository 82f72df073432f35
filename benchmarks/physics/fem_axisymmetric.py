"""An independent finite-element code for the pressed dome: axisymmetric, large strain, frictionless.

It shares nothing with the simulator but the physics. Eight-node quadrilaterals with reduced (2×2) integration do not lock at
Poisson's ratio 0.49, and the skin is a solid layer instead of a shell. Newton's method has a consistent tangent; contact
with a flat plate is an active set on the surface nodes.

Frame: the dome's axis is z, its base is the plane z = 0 (bonded), its apex z = radius.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import spsolve

_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
_MIDSIDES = np.array([[0, -1], [1, 0], [0, 1], [-1, 0]], float)
_GAUSS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / np.sqrt(3)


@dataclass(frozen=True)
class Layer:
    """A neo-Hookean layer of the dome, from the radius of the layer inside it to its own."""

    radius: float
    """Outer radius, m."""
    young: float
    """Young's modulus, Pa."""
    poisson: float
    """Poisson's ratio, -."""
    elements: int
    """Number of elements through its thickness."""


def shape(point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the serendipity shape functions (8,) and their derivatives (8, 2) at a local point (2,)."""
    x, y = point
    n, d = np.zeros(8), np.zeros((8, 2))
    for i, (a, b) in enumerate(_CORNERS):
        n[i] = 0.25 * (1 + a * x) * (1 + b * y) * (a * x + b * y - 1)
        d[i] = 0.25 * a * (1 + b * y) * (2 * a * x + b * y), 0.25 * b * (1 + a * x) * (a * x + 2 * b * y)
    for i, (a, b) in enumerate(_MIDSIDES, start=4):
        if a == 0:
            n[i] = 0.5 * (1 - x * x) * (1 + b * y)
            d[i] = -x * (1 + b * y), 0.5 * b * (1 - x * x)
        else:
            n[i] = 0.5 * (1 + a * x) * (1 - y * y)
            d[i] = 0.5 * a * (1 - y * y), -y * (1 + a * x)
    return n, d


class Dome:
    """A layered hemisphere bonded at its base disc, pressed at the apex by a frictionless plate."""

    def __init__(self, layers: Sequence[Layer], polar_elements: int = 40) -> None:
        """Mesh the dome.

        Args:
            layers: From the centre outwards.
            polar_elements: Number of elements from the apex to the base.
        """
        radii = [0.0]
        material = []
        for layer in layers:
            radii += list(np.linspace(radii[-1], layer.radius, layer.elements + 1)[1:])
            mu = layer.young / (2 * (1 + layer.poisson))
            material += [(mu, 2 * mu * layer.poisson / (1 - 2 * layer.poisson))] * layer.elements
        # Nodes on a grid of half-elements in (radius, polar angle); polar elements are smaller near the apex.
        r = np.interp(np.arange(2 * len(radii) - 1) / 2, np.arange(len(radii)), radii)
        t = np.linspace(0, 1, 2 * polar_elements + 1)
        t[1::2] = (t[0:-1:2] + t[2::2]) / 2
        polar = np.pi / 2 * (0.5 * t + 0.5 * t**2)
        polar[1::2] = (polar[0:-1:2] + polar[2::2]) / 2
        index = np.arange(len(r) * len(polar)).reshape(len(r), len(polar))
        self.nodes = np.stack([np.outer(r, np.sin(polar)), np.outer(r, np.cos(polar))], -1).reshape(-1, 2)
        elements, mu, lam = [], [], []
        for i in range(len(radii) - 1):
            for j in range(polar_elements):
                a, b = 2 * i, 2 * j
                corners = [(a, b), (a + 2, b), (a + 2, b + 2), (a, b + 2)]
                midsides = [(a + 1, b), (a + 2, b + 1), (a + 1, b + 2), (a, b + 1)]
                elements.append([index[p] for p in corners + midsides])
                mu.append(material[i][0])
                lam.append(material[i][1])
        self.elements, self.mu, self.lam = np.array(elements), np.array(mu), np.array(lam)
        self.surface = index[-1]
        used = np.zeros(len(self.nodes), bool)
        used[self.elements] = True
        fixed = np.zeros((len(self.nodes), 2), bool)
        fixed[~used] = True  # middles of quadrilaterals: not nodes of a serendipity element
        fixed[self.nodes[:, 1] < 1e-9] = True
        fixed[self.nodes[:, 0] < 1e-9, 0] = True
        self.fixed = fixed
        self._prepare()

    def _prepare(self) -> None:
        """Compute the gradient operators and the weights of the integration points."""
        x = self.nodes[self.elements]
        grads, weights, values = [], [], []
        for point in _GAUSS:
            n, d = shape(point)
            jac = np.einsum("ka,ekb->eab", d, x)
            grads.append(np.einsum("ka,eba->ekb", d, np.linalg.inv(jac)))
            values.append(np.broadcast_to(n, x.shape[:2]))
            weights.append(np.abs(np.linalg.det(jac)) * 2 * np.pi * (x[..., 0] @ n))
        # Rows of b: d(F_rr, F_rz, F_zr, F_zz, F_tt)/d(u_r, u_z) of each node.
        grads, values = np.stack(grads, 1), np.stack(values, 1)
        radius = np.einsum("egk,ek->eg", values, x[..., 0])
        b = np.zeros((*grads.shape[:2], 5, 8, 2))
        b[..., 0, :, 0], b[..., 1, :, 0] = grads[..., 0], grads[..., 1]
        b[..., 2, :, 1], b[..., 3, :, 1] = grads[..., 0], grads[..., 1]
        b[..., 4, :, 0] = values / radius[..., None]
        self._b, self._w = b.reshape(*b.shape[:3], 16), np.stack(weights, 1)

    def _forces(self, u: np.ndarray) -> tuple[np.ndarray, csr_array]:
        """Return the internal forces (n, 2) N and the tangent stiffness, N/m, at a displacement (n, 2) m.

        Raises:
            ArithmeticError: An element has turned inside out.
        """
        dofs = (2 * self.elements[..., None] + np.arange(2)).reshape(len(self.elements), 16)
        f = np.einsum("egij,ej->egi", self._b, u.ravel()[dofs]) + np.array([1, 0, 0, 1, 1.0])
        rr, rz, zr, zz, tt = np.moveaxis(f, -1, 0)
        det = rr * zz - rz * zr
        j = det * tt
        if j.min() <= 0:
            raise ArithmeticError("an element of the reference solution turned inside out")
        g = np.stack([zz / det, -zr / det, -rz / det, rr / det, 1 / tt], -1)  # inverse transpose of F
        mu, lam = self.mu[:, None], self.lam[:, None]
        p = mu[..., None] * (f - g) + (lam * (j - 1) * j)[..., None] * g
        # d(F^-T)_ij / dF_kl = -g_il g_kj, in the order of the five components
        swap = np.zeros((*j.shape, 5, 5))
        full = np.zeros((*j.shape, 2, 2))
        full[..., 0, 0], full[..., 0, 1], full[..., 1, 0], full[..., 1, 1] = g[..., 0], g[..., 1], g[..., 2], g[..., 3]
        swap[..., :4, :4] = np.einsum("egil,egkj->egijkl", full, full).reshape(*j.shape, 4, 4)
        swap[..., 4, 4] = g[..., 4] ** 2
        tangent = (
            mu[..., None, None] * np.eye(5)
            + (mu - lam * (j - 1) * j)[..., None, None] * swap
            + (lam * (2 * j - 1) * j)[..., None, None] * np.einsum("egi,egj->egij", g, g)
        )
        force = np.einsum("egij,egi,eg->ej", self._b, p, self._w)
        stiffness = np.einsum("egik,egij,egjl,eg->ekl", self._b, tangent, self._b, self._w, optimize=True)
        total = np.zeros(u.size)
        np.add.at(total, dofs, force)
        rows, cols = np.repeat(dofs, 16, 1).ravel(), np.tile(dofs, (1, 16)).ravel()
        return total.reshape(-1, 2), coo_array((stiffness.ravel(), (rows, cols)), (u.size, u.size)).tocsr()

    def press(self, depths: Iterable[float]) -> Iterator[tuple[float, np.ndarray]]:
        """Press to each depth (m, increasing) in turn.

        Yields:
            Force, N, and displacement (n, 2), m.

        Raises:
            ArithmeticError: The solution does not converge.
        """
        apex = self.nodes[self.surface, 1].max()
        u = np.zeros_like(self.nodes)
        active = np.zeros(len(self.surface), bool)
        active[0] = True
        for depth in depths:
            plate = apex - depth
            active |= self.nodes[self.surface, 1] + u[self.surface, 1] > plate + 1e-12
            for _ in range(60):
                reaction = self._solve(u, self.surface[active], plate)
                pulled = reaction < -1e-9
                through = ~active & (self.nodes[self.surface, 1] + u[self.surface, 1] > plate + 1e-9)
                if not through.any() and not pulled.any():
                    break
                if through.any():
                    active |= through
                else:  # release the outermost first: midside and corner nodes share a face's load unevenly
                    active[np.flatnonzero(active)[np.flatnonzero(pulled)[-1]]] = False
            else:
                raise ArithmeticError("the reference solution's contact did not settle")
            yield float(reaction.sum()), u.copy()

    def _solve(self, u: np.ndarray, touching: np.ndarray, plate: float) -> np.ndarray:
        """Solve by Newton's method with the touching nodes on the plate.

        Args:
            u: (n, 2) displacement, m; changed in place.
            touching: (k,) indices of nodes.
            plate: Height of the plate, m.

        Returns:
            Forces (k,), N, of the touching nodes on the plate.

        Raises:
            ArithmeticError: Newton's method does not converge.
        """
        fixed = self.fixed.copy()
        fixed[touching, 1] = True
        free = np.flatnonzero(~fixed.ravel())
        step = plate - (self.nodes[touching, 1] + u[touching, 1])
        for iteration in range(40):
            force, stiffness = self._forces(u)
            residual = -force.ravel()
            move = np.zeros(u.size)
            if iteration == 0:
                move[2 * touching + 1] = step
                residual = residual - stiffness @ move
            move[free] = np.asarray(spsolve(stiffness[free][:, free].tocsc(), residual[free]))
            u += move.reshape(-1, 2)
            if np.abs(move).max() < 1e-10:
                return -self._forces(u)[0][touching, 1]
        raise ArithmeticError("the reference solution did not converge")
