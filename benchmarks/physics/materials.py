"""The flexes' materials against closed-form solutions: `tactip bench materials`.

Small bodies with exactly the settings of tactip_model/soft_body.py: for gel of both of MuJoCo's laws a patch test and a bar
in tension and compression; for the skin a strip, plates and the tip's own dome. Writes docs/materials.md and
docs/materials.json.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import permutations
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import Delaunay

from tactip_twin.benchmarks.physics.fem_tetrahedra import lame
from tactip_twin.benchmarks.physics.options import MaterialsOptions
from tactip_twin.benchmarks.report import table, write_results
from tactip_twin.sim.contact.fidelity import FIDELITIES
from tactip_twin.tactip_model.design import Materials, TipGeometry
from tactip_twin.tactip_model.mesh import GOLDEN_ANGLE, Resolution, build_mesh
from tactip_twin.tactip_model.soft_body import STABLE_NEO_HOOKEAN, gel_attributes, skin_attributes

LAWS = {"stable neo-Hooke": STABLE_NEO_HOOKEAN, "St Venant-Kirchhoff": 0}
"""Values of MjsFlex.elastic3d by the name of the law."""

POISSONS = (0.3, 0.45, 0.47)

STRETCHES = {
    "stable neo-Hooke": (0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.5, 1.75, 2.0),
    # Below 0.577 the force of this law falls again, and above sqrt(1 + 1/nu) its bar has no width.
    "St Venant-Kirchhoff": (0.65, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4),
}

PATCHES = {
    "stretched by 0.3": np.diag([1.3, 0.9, 0.9]),
    "compressed by 0.3": np.diag([0.7, 1.15, 1.15]),
    "sheared by 0.5": np.array([[1, 0.5, 0], [0, 1, 0], [0, 0, 1.0]]),
}
"""Deformation gradients by name."""

_STEP_S = 7e-3
_FIXED_KG = 1e6
_NODE_KG = 1e-6
_SMALL_M = 5e-6  # deflection at which plates and shells are compared with linear theory


class Specimen:
    """A flex on its own: some coordinates fixed at given positions, the others free."""

    def __init__(self, vertices: ArrayLike, elements: np.ndarray, attributes: Mapping[str, Any], fixed: ArrayLike) -> None:
        """Compile the model.

        Args:
            vertices: (n, 3), m.
            elements: (m, 3) or (m, 4) int, triangles or tetrahedra.
            attributes: Attributes of the flex that define its material.
            fixed: (n, 3) bool, the coordinates that are fixed.
        """
        self.vertices, self.fixed = np.asarray(vertices, float), np.asarray(fixed, bool)
        spec = mujoco.MjSpec()
        spec.option.gravity = [0, 0, 0]
        spec.option.timestep = _STEP_S
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
        spec.option.solver = mujoco.mjtSolver.mjSOL_CG
        spec.option.iterations, spec.option.tolerance = 3000, 1e-13
        names = []
        for i, (position, fixed_axes) in enumerate(zip(self.vertices, self.fixed, strict=True)):
            body = spec.worldbody.add_body(
                name=f"{i}", pos=position, mass=_NODE_KG, inertia=[1e-9] * 3, explicitinertial=True
            )
            for axis, is_fixed in zip(np.eye(3), fixed_axes, strict=True):
                # A fixed coordinate is set at each step; its inertia fixes it within the step.
                body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, armature=_FIXED_KG if is_fixed else 0)
            names.append(body.name)
        spec.add_flex(
            name="flex",
            dim=elements.shape[1] - 1,
            radius=0,
            vertbody=names,
            vert=np.zeros(self.vertices.size),
            elem=elements.ravel(),
            contype=0,
            conaffinity=0,
            **attributes,
        )
        self.model = spec.compile()
        self.model.stat.meaninertia = _NODE_KG
        self.data = mujoco.MjData(self.model)

    def forces(self, positions: np.ndarray) -> np.ndarray:
        """Return the elastic forces (n, 3), N, on the vertices at positions (n, 3), m."""
        self.data.qpos[:], self.data.qvel[:] = (positions - self.vertices).ravel(), 0
        mujoco.mj_forward(self.model, self.data)
        return self.data.qfrc_passive.reshape(-1, 3).copy()

    def rest(
        self, positions: np.ndarray, load: np.ndarray | None = None, steps: int = 400, within: float = 1e-6
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulate until the free coordinates are at rest.

        Args:
            positions: (n, 3), m: the fixed coordinates, and the start of the free ones.
            load: (n, 3), N; none by default.
            steps: Maximum number of time steps.
            within: Allowed imbalance of the free coordinates, relative to the maximum load or, without a load, to the
                maximum elastic force.

        Returns:
            Positions (n, 3), m, and elastic forces (n, 3), N.

        Raises:
            ArithmeticError: The forces do not balance after `steps`.
        """
        fixed, load = self.fixed.ravel(), np.zeros_like(self.vertices) if load is None else load
        q = (positions - self.vertices).ravel()
        self.data.qpos[:], self.data.qvel[:] = q, 0
        self.data.qacc_warmstart[:] = 0
        self.data.qfrc_applied[:] = load.ravel()
        for step in range(steps):
            self.data.qpos[fixed], self.data.qvel[fixed] = q[fixed], 0
            mujoco.mj_step(self.model, self.data)
            if step % 20 == 19:
                now = self.vertices + np.where(fixed, q, self.data.qpos).reshape(-1, 3)
                velocity = self.data.qvel.copy()
                force = self.forces(now)
                balance = np.abs((force + load)[~self.fixed]).max(initial=0.0)
                if balance < within * (np.abs(load).max() or np.abs(force).max()):
                    return now, force
                self.data.qvel[:] = velocity
        raise ArithmeticError("a specimen did not settle")


def bar_stress(law: str, young: float, poisson: float, stretch: float) -> tuple[float, float]:
    """Return the force over undeformed area, Pa, and the sides' stretch of a bar with free sides.

    In closed form: zero stress on the sides gives J = 1 + (1 - 2 nu)(1 - 1/stretch) for `stable neo-Hooke`, and
    sides^2 = 1 - nu (stretch^2 - 1) for `St Venant-Kirchhoff`.

    Args:
        law: One of LAWS.
        young: Young's modulus, Pa.
        poisson: Poisson's ratio, -.
        stretch: Stretch of the bar, -.
    """
    if law == "stable neo-Hooke":
        side = np.sqrt((1 + (1 - 2 * poisson) * (1 - 1 / stretch)) / stretch)
        return lame(young, poisson)[1] * (stretch - side**2 / stretch), side
    return young * stretch * (stretch**2 - 1) / 2, np.sqrt(1 - poisson * (stretch**2 - 1))


def block(cells: tuple[int, int, int], size: ArrayLike, jitter: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """Return irregular tetrahedra of a block.

    Args:
        cells: Number of cells along each axis; each is cut into six tetrahedra along one diagonal.
        size: (3,), m.
        jitter: Maximum displacement of a cell's corner, in cells; the block's faces stay plane.

    Returns:
        Vertices (n, 3), m, and tetrahedra (m, 4), of positive volume.
    """
    counts = np.array(cells) + 1
    grid = np.array(list(np.ndindex(*counts)))
    jittered = np.random.default_rng(0).uniform(-jitter, jitter, grid.shape)
    jittered[(grid == 0) | (grid == np.array(cells))] = 0
    number = np.arange(len(grid)).reshape(counts)
    tetrahedra = []
    for cell in np.ndindex(*cells):
        for order in permutations(range(3)):
            corner, path = np.array(cell), [np.array(cell)]
            for axis in order:
                corner = corner + np.eye(3, dtype=int)[axis]
                path.append(corner)
            ring = [number[tuple(p)] for p in path]
            odd = np.linalg.det(np.eye(3)[list(order)]) < 0
            tetrahedra.append(ring[:2] + ring[:1:-1] if odd else ring)
    return (grid + jittered) * np.array(size) / cells, np.array(tetrahedra)


def gel(poisson: float, law: str = "stable neo-Hooke", young: float = 2e4) -> dict[str, Any]:
    """Return the attributes of a gel's flex as in tactip_model/soft_body.py, for any Poisson's ratio and either law."""
    materials = replace(Materials(), gel_young_pa=young, gel_poisson=poisson)
    return gel_attributes(materials, Resolution(poisson_limit=0.5)) | {"elastic3d": LAWS[law]}


def patch_error(law: str, gradient: np.ndarray, poisson: float = 0.45) -> float:
    """Return the maximum distance of an inner vertex from its affine position, relative to the block's size.

    The surface of a block is moved by a gradient (3, 3); inside, linear tetrahedra must follow it exactly. Inner vertices
    start up to a tenth of a cell away from there.
    """
    vertices, tetrahedra = block((4, 4, 4), (10e-3,) * 3)
    on_face = np.any((vertices < 1e-9) | (vertices > 10e-3 - 1e-9), axis=1)
    affine = vertices @ gradient.T
    start = affine + np.where(on_face[:, None], 0, np.random.default_rng(1).uniform(-0.25e-3, 0.25e-3, affine.shape))
    fixed = np.repeat(on_face[:, None], 3, 1)
    positions, _ = Specimen(vertices, tetrahedra, gel(poisson, law), fixed).rest(start, within=1e-7)
    return float(np.linalg.norm(positions - affine, axis=1).max() / 10e-3)


def bar_ratios(law: str, poisson: float, young: float = 2e4) -> tuple[dict[float, float], float]:
    """Return the force of a bar of tetrahedra over the closed form, by stretch, and the maximum error of its sides.

    Args:
        law: One of LAWS; its STRETCHES are applied.
        poisson: Poisson's ratio, -.
        young: Young's modulus, Pa.
    """
    size = np.array([8e-3, 4e-3, 4e-3])
    vertices, tetrahedra = block((4, 2, 2), size)
    right = vertices[:, 0] > size[0] - 1e-9
    # A quarter of the bar: its planes of symmetry keep it from buckling.
    fixed = vertices < 1e-9
    fixed[right, 0] = True
    specimen = Specimen(vertices, tetrahedra, gel(poisson, law, young), fixed)
    ratios, sides = {}, 0.0
    for sign in (1, -1):
        stretches = sorted((s for s in STRETCHES[law] if sign * (s - 1) > 0), key=lambda s: sign * s)
        positions, force = vertices.copy(), np.zeros(vertices.shape)
        reached = 1.0
        for stretch in stretches:
            # In larger steps, elements next to the grip would turn inside out.
            for part in np.linspace(reached, stretch, 1 + int(np.ceil(abs(stretch - reached) / 0.05)))[1:]:
                positions[right, 0] = size[0] * part
                positions, force = specimen.rest(positions)
            reached = stretch
            expected, side = bar_stress(law, young, poisson, stretch)
            ratios[stretch] = float(-force[right, 0].sum() / (expected * size[1] * size[2]))
            width = positions[:, 1].max() - positions[:, 1].min()
            sides = max(sides, abs(float(width / size[1] / side) - 1))
    return dict(sorted(ratios.items())), sides


def sheet(length: float, width: float, spacing: float, jitter: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """Return irregular triangles of a rectangle: vertices (n, 3), m, with z = 0, and triangles (m, 3).

    Args:
        length: Along x, m.
        width: Along y, m.
        spacing: Of the vertices, m.
        jitter: Maximum displacement of an inner vertex, in cells.
    """
    cells = np.maximum(np.round(np.array([length, width]) / spacing).astype(int), 1)
    grid = np.array(list(np.ndindex(*(cells + 1))), float)
    jittered = np.random.default_rng(0).uniform(-jitter, jitter, grid.shape)
    jittered[(grid == 0) | (grid == cells)] = 0
    plane = (grid + jittered) * np.array([length, width]) / cells
    return np.insert(plane, 2, 0, axis=1), Delaunay(plane).simplices


def disc(radius: float, spacing: float, lattice: str = "spiral") -> tuple[np.ndarray, np.ndarray]:
    """Return triangles of a disc: vertices (n, 3), m, with z = 0 and the centre first, and triangles (m, 3).

    Args:
        radius: Radius of the last but one ring of vertices, m; the last ring is outside it.
        spacing: Of the vertices, m.
        lattice: `spiral`, as in the tip's own skin, or `equilateral`.
    """
    if lattice == "spiral":
        count = round(np.pi * (radius - spacing / 2) ** 2 / (spacing**2 * np.sqrt(3) / 2))
        r = (radius - 0.9 * spacing) * np.sqrt(np.arange(count) / (count - 1))
        inner = r * np.exp(1j * GOLDEN_ANGLE * np.arange(count))
    else:
        i, j = np.meshgrid(*[np.arange(-n, n + 1) for n in [int(2 * radius / spacing)] * 2])
        inner = (spacing * (i + j * np.exp(1j * np.pi / 3))).ravel()
        inner = inner[np.argsort(np.abs(inner))]
        inner = inner[np.abs(inner) < radius - 0.6 * spacing]
    number = round(2 * np.pi * radius / spacing)
    turn = 2 * np.pi * np.arange(number) / number
    rings = [(radius + k * spacing * np.sqrt(3) / 2) * np.exp(1j * (turn + k * np.pi / number)) for k in (0, 1)]
    z = np.concatenate([inner, *rings])
    plane = np.stack([z.real, z.imag], 1)
    return np.insert(plane, 2, 0, axis=1), Delaunay(plane).simplices


def rigidity(materials: Materials) -> float:
    """Return the bending rigidity D of a plate of the skin, N m: E t^3 / (12 (1 - nu^2))."""
    return materials.skin_young_pa * materials.skin_thickness_m**3 / (12 * (1 - materials.skin_poisson**2))


def strip_ratios(materials: Materials, stretches: Sequence[float] = (0.8, 0.9, 1.1, 1.25)) -> dict[float, float]:
    """Return the force of a stretched strip of skin over that of plane-stress St Venant-Kirchhoff, by stretch.

    The closed form is that of the bar (`bar_stress`) times the thickness. A quarter of the strip is kept flat, so it does
    not buckle.
    """
    length, width = 20e-3, 8e-3
    vertices, triangles = sheet(length, width, 2e-3)
    right = vertices[:, 0] > length - 1e-9
    fixed = vertices < 1e-9
    fixed[right, 0] = True
    specimen = Specimen(vertices, triangles, skin_attributes(materials), fixed)
    out = {}
    for stretch in stretches:
        positions = vertices * [stretch, 1, 1]
        _, force = specimen.rest(positions)
        stress, _ = bar_stress("St Venant-Kirchhoff", materials.skin_young_pa, materials.skin_poisson, stretch)
        out[stretch] = float(-force[right, 0].sum() / (stress * width * materials.skin_thickness_m))
    return out


def curving_ratios(materials: Materials, spacing: float, lattice: str = "spiral") -> dict[str, float]:
    """Return the moment of a bent plate over Kirchhoff's for `cylinder`, `sphere` and `saddle`.

    The shape is given, z = (a x^2 + b y^2)/2, and the slope of the energy along it is measured from the vertex forces.
    Kirchhoff's energy over area is D/2 ((a + b)^2 - 2 (1 - nu) a b). Two discs separate the area's energy from the border's.

    Args:
        materials: Of the skin.
        spacing: Of the vertices, m.
        lattice: As for `disc`.
    """
    radii, curvature = (20e-3, 10e-3), 1e-2
    d, nu, slopes = rigidity(materials), materials.skin_poisson, []
    bent = {"cylinder": (1, 0), "sphere": (1, 1), "saddle": (1, -1)}
    for radius in radii:
        vertices, triangles = disc(radius, spacing, lattice)
        specimen = Specimen(vertices, triangles, skin_attributes(materials), np.ones(vertices.shape, bool))
        slopes.append({})
        for name, (a, b) in bent.items():
            shape = vertices[:, :2] ** 2 @ [a / 2, b / 2]
            force = specimen.forces(vertices + np.outer(curvature * shape, [0, 0, 1]))
            slopes[-1][name] = -(force[:, 2] * shape).sum() / (np.pi * radius * curvature)
    return {
        name: float((slopes[0][name] - slopes[1][name]) / (radii[0] - radii[1]) / (d * (a * a + b * b + 2 * nu * a * b)))
        for name, (a, b) in bent.items()
    }


def cantilever_ratio(materials: Materials, spacing: float) -> float:
    """Return the deflection of a strip under a small load at its end over F L^3 / (3 E I).

    The strip is 20 by 6 mm, clamped at one end, with a spacing in m.
    """
    length, width = 20e-3, 6e-3
    compliance = length**3 / (3 * materials.skin_young_pa * width * materials.skin_thickness_m**3 / 12)
    load = _SMALL_M / compliance
    vertices, triangles = sheet(length + spacing, width, spacing)
    vertices = vertices - [spacing, 0, 0]
    fixed = np.zeros(vertices.shape, bool)
    fixed[vertices[:, 0] < 0.3 * spacing] = True
    end = vertices[:, 0] > length - 1e-9
    force = np.zeros(vertices.shape)
    force[end, 2] = load / end.sum()
    positions, _ = Specimen(vertices, triangles, skin_attributes(materials), fixed).rest(vertices, force, 2000, 1e-4)
    return float(positions[end, 2].mean() / _SMALL_M)


def clamped_plate_ratio(materials: Materials, spacing: float, lattice: str = "spiral") -> float:
    """Return the deflection at the centre of a clamped disc under pressure over q a^4 / (64 D), for a radius of 15 mm."""
    radius = 15e-3
    pressure = _SMALL_M * 64 * rigidity(materials) / radius**4
    vertices, triangles = disc(radius, spacing, lattice)
    fixed = np.repeat((np.hypot(*vertices[:, :2].T) > radius - 1e-9)[:, None], 3, 1)
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    area = np.zeros(len(vertices))
    for corner in triangles.T:
        np.add.at(area, corner, np.abs(np.cross(b - a, c - a)[:, 2]) / 6)
    load = np.outer(pressure * area, [0, 0, 1.0])
    positions, _ = Specimen(vertices, triangles, skin_attributes(materials), fixed).rest(vertices, load, 2000, 1e-4)
    return float(positions[0, 2] / _SMALL_M)


def dome_ratio(materials: Materials, resolution: Resolution) -> tuple[float, float]:
    """Return the deflection of the tip's own dome of skin, without gel, under a point load at the apex over Reissner's.

    Reissner 1946, a shallow spherical shell: F R sqrt(3 (1 - nu^2)) / (4 E t^2). The deflection is half the difference of
    pull and push. The second number is the maximum motion of its vertices without a load, m: the bending of a curved skin is
    not quite at rest.
    """
    mesh = build_mesh(TipGeometry(), resolution)
    vertices = mesh.vertices[: mesh.surface_count]
    fixed = np.repeat(mesh.bonded[: mesh.surface_count, None], 3, 1)
    apex = np.hypot(*vertices[:, :2].T).argmin()
    radius = np.linalg.norm(vertices[apex] - mesh.centre)
    radial = (vertices[apex] - mesh.centre) / radius
    young, nu, t = materials.skin_young_pa, materials.skin_poisson, materials.skin_thickness_m
    load = _SMALL_M / (radius * np.sqrt(3 * (1 - nu**2)) / (4 * young * t**2))
    specimen, force, moved = (
        Specimen(vertices, mesh.triangles, skin_attributes(materials), fixed),
        np.zeros(vertices.shape),
        [],
    )
    for sign in (1, -1):
        force[apex] = sign * load * radial
        positions, _ = specimen.rest(vertices, force, 2000, 1e-4)
        moved.append(positions - vertices)
    unloaded = np.linalg.norm(moved[0] + moved[1], axis=1).max() / 2
    return float((moved[0] - moved[1])[apex] @ radial / 2 / _SMALL_M), float(unloaded)


def measure() -> dict[str, Any]:
    """Return all results, for docs/materials.json."""
    skin = Materials()
    sizes = {"2.5": 2.5e-3, "1.5": 1.5e-3, "1.0": 1e-3}
    result = {
        "patch": {law: {name: patch_error(law, gradient) for name, gradient in PATCHES.items()} for law in LAWS},
        "bar": [
            {"law": law, "poisson": poisson, "force_ratio": ratios, "worst_side_error": sides}
            for law in LAWS
            for poisson in POISSONS
            for ratios, sides in [bar_ratios(law, poisson)]
        ],
        "strip": strip_ratios(skin),
        "curving": {
            lattice: {name: curving_ratios(skin, h, lattice) for name, h in sizes.items()}
            for lattice in ("spiral", "equilateral")
        },
        "clamped_plate": {
            lattice: {name: clamped_plate_ratio(skin, h, lattice) for name, h in sizes.items()}
            for lattice in ("spiral", "equilateral")
        },
        "cantilever": {name: cantilever_ratio(skin, h) for name, h in sizes.items()},
        "dome": {},
    }
    for name, fidelity in FIDELITIES.items():
        ratio, unloaded = dome_ratio(skin, fidelity.mesh)
        result["dome"][name] = {"deflection_ratio": ratio, "unloaded_mm": 1e3 * unloaded}
    return result


def run(options: MaterialsOptions) -> dict[str, Any]:
    """Measure, write materials.json and materials.md, and return the results."""
    result = measure()
    write_results("materials", result, tables(result), options.out)
    return result


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Return the tables of docs/materials.md from materials.json."""
    patches, sizes = list(next(iter(result["patch"].values()))), list(result["cantilever"])
    bars = []
    for row in result["bar"]:
        ratios = {float(k): v for k, v in row["force_ratio"].items()}
        worst = max(abs(r - 1) for r in ratios.values())
        stretches = f"{min(ratios)} to {max(ratios)}"
        bars.append([row["law"], row["poisson"], stretches, f"{worst:.0e}", f"{row['worst_side_error']:.0e}"])
    bent = [
        [f"moment, bent to a {shape}", lattice, *(f"{by_size[size][shape]:.2f}" for size in sizes)]
        for lattice, by_size in result["curving"].items()
        for shape in ("cylinder", "sphere", "saddle")
    ]
    bent += [
        ["deflection of a clamped disc of 15 mm", lattice, *(f"{by_size[size]:.2f}" for size in sizes)]
        for lattice, by_size in result["clamped_plate"].items()
    ]
    strip = [f"{result['cantilever'][size]:.2f}" for size in sizes]
    bent.append(["deflection of a strip, 20 by 6 mm", "jittered squares", *strip])
    dome = [[name, f"{r['deflection_ratio']:.2f}", f"{r['unloaded_mm']:.4f}"] for name, r in result["dome"].items()]
    worst = max(abs(r - 1) for r in result["strip"].values())
    return {
        "patch": table(["law", *patches], [[law, *(f"{e:.0e}" for e in v.values())] for law, v in result["patch"].items()]),
        "bar": table(["law", "Poisson's ratio", "stretch", "error of force", "error of the sides"], bars),
        "strip": f"Maximum relative error of the force: {worst:.0e}.",
        "bending": table(["ratio to the closed form", "mesh", *(f"spacing {size} mm" for size in sizes)], bent),
        "dome": table(["mesh", "deflection, ratio to the closed form", "motion without a load, mm"], dome),
    }
