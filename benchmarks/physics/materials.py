"""The flexes' materials against closed forms: `tactip bench materials`.

Small bodies with the very settings of tactip_model/soft_body.py: a patch test and a bar in tension and compression for
gel of
both of MuJoCo's laws; a strip, plates and the tip's own dome for the skin. Writes docs/materials.md and
docs/materials.json.
"""

import json
from dataclasses import replace
from itertools import permutations
from typing import Any

import mujoco
import numpy as np
from scipy.spatial import Delaunay

from tactip_twin.benchmarks.options import MaterialsOptions
from tactip_twin.benchmarks.physics.fem_tetrahedra import lame
from tactip_twin.sim.contact.fidelity import FIDELITIES
from tactip_twin.tactip_model.design import Materials, TipGeometry
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.mesh import GOLDEN_ANGLE, Resolution, build_mesh
from tactip_twin.tactip_model.soft_body import STABLE_NEO_HOOKEAN, gel_attributes, skin_attributes

LAWS = {"stable neo-Hooke": STABLE_NEO_HOOKEAN, "St Venant-Kirchhoff": 0}
"""Name to MjsFlex.elastic3d."""

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
"""Deformation gradients."""

_STEP_S = 7e-3
_HELD_KG = 1e6
_NODE_KG = 1e-6
_SMALL_M = 5e-6  # deflection at which plates and shells are compared with linear theory


class Specimen:
    """A flex alone in the world: some coordinates held at given places, the others free, at rest."""

    def __init__(self, vertices, elements, attributes, held):
        """vertices: (n, 3) m. elements: (m, 3 or 4) int. attributes: dict of a flex's. held: (n, 3) bool."""
        self.vertices, self.held = np.asarray(vertices, float), np.asarray(held, bool)
        spec = mujoco.MjSpec()
        spec.option.gravity = [0, 0, 0]
        spec.option.timestep = _STEP_S
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
        spec.option.solver = mujoco.mjtSolver.mjSOL_CG
        spec.option.iterations, spec.option.tolerance = 3000, 1e-13
        names = []
        for i, (place, hold) in enumerate(zip(self.vertices, self.held, strict=True)):
            body = spec.worldbody.add_body(name=f"{i}", pos=place, mass=_NODE_KG, inertia=[1e-9] * 3, explicitinertial=True)
            for axis, fast in zip(np.eye(3), hold, strict=True):
                # A held coordinate is set at each step; its inertia keeps it there within the step.
                body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, armature=_HELD_KG if fast else 0)
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

    def forces(self, places):
        """Elastic forces (n, 3) N on the vertices at places (n, 3) m."""
        self.data.qpos[:], self.data.qvel[:] = (places - self.vertices).ravel(), 0
        mujoco.mj_forward(self.model, self.data)
        return self.data.qfrc_passive.reshape(-1, 3).copy()

    def rest(self, places, load=None, steps=400, within=1e-6):
        """Let the free coordinates come to rest.

        places: (n, 3) m, where the held ones are held and the free ones begin. load: (n, 3) N or None. Returns the places
        (n, 3) and the elastic forces (n, 3). Raises ArithmeticError where the forces on them do not balance to `within` of
        the greatest load (without one, of the greatest force that holds) after `steps`.
        """
        held, load = self.held.ravel(), np.zeros_like(self.vertices) if load is None else load
        q = (places - self.vertices).ravel()
        self.data.qpos[:], self.data.qvel[:] = q, 0
        self.data.qacc_warmstart[:] = 0
        self.data.qfrc_applied[:] = load.ravel()
        for step in range(steps):
            self.data.qpos[held], self.data.qvel[held] = q[held], 0
            mujoco.mj_step(self.model, self.data)
            if step % 20 == 19:
                now = self.vertices + np.where(held, q, self.data.qpos).reshape(-1, 3)
                velocity = self.data.qvel.copy()
                force = self.forces(now)
                balance = np.abs((force + load)[~self.held]).max(initial=0.0)
                if balance < within * (np.abs(load).max() or np.abs(force).max()):
                    return now, force
                self.data.qvel[:] = velocity
        raise ArithmeticError("a specimen did not come to rest")


def bar_stress(law, young, poisson, stretch):
    """Force over undeformed area, Pa, and the sides' stretch, of a bar with free sides pulled to `stretch`.

    Closed: setting the sides' stress to zero gives J = 1 + (1 - 2 nu)(1 - 1/stretch) for `stable neo-Hooke`, and
    sides^2 = 1 - nu (stretch^2 - 1) for `St Venant-Kirchhoff`.
    """
    if law == "stable neo-Hooke":
        side = np.sqrt((1 + (1 - 2 * poisson) * (1 - 1 / stretch)) / stretch)
        return lame(young, poisson)[1] * (stretch - side**2 / stretch), side
    return young * stretch * (stretch**2 - 1) / 2, np.sqrt(1 - poisson * (stretch**2 - 1))


def block(cells, size, jitter=0.2):
    """Irregular tetrahedra of a block: vertices (n, 3), m, and tetrahedra (m, 4), positive.

    cells: (3,) int. size: (3,) m. Each cell is cut into six along one diagonal; `jitter`, in cells, moves its corners but
    leaves the block's faces plane.
    """
    counts = np.array(cells) + 1
    grid = np.array(list(np.ndindex(*counts)))
    draw = np.random.default_rng(0).uniform(-jitter, jitter, grid.shape)
    draw[(grid == 0) | (grid == np.array(cells))] = 0
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
    return (grid + draw) * np.array(size) / cells, np.array(tetrahedra)


def gel(poisson, law="stable neo-Hooke", young=2e4):
    """Attributes of a gel's flex as tactip_model/soft_body.py makes them, of any Poisson's ratio and either law."""
    materials = replace(Materials(), gel_young_pa=young, gel_poisson=poisson)
    return gel_attributes(materials, Resolution(poisson_limit=0.5, locked_stiffness=1.0)) | {"elastic3d": LAWS[law]}


def patch_error(law, gradient, poisson=0.45):
    """Greatest distance of an inner vertex from its affine place, over the block's size.

    The block's surface is moved by `gradient` (3, 3); inside, linear tetrahedra must follow it exactly. Inner vertices start
    up to a tenth of a cell away from there.
    """
    vertices, tetrahedra = block((4, 4, 4), (10e-3,) * 3)
    on_face = ((vertices < 1e-9) | (vertices > 10e-3 - 1e-9)).any(1)
    affine = vertices @ gradient.T
    start = affine + np.where(on_face[:, None], 0, np.random.default_rng(1).uniform(-0.25e-3, 0.25e-3, affine.shape))
    held = np.repeat(on_face[:, None], 3, 1)
    places, _ = Specimen(vertices, tetrahedra, gel(poisson, law), held).rest(start, within=1e-7)
    return float(np.linalg.norm(places - affine, axis=1).max() / 10e-3)


def bar_ratios(law, poisson, young=2e4):
    """Force of a bar of tetrahedra over the closed form at the law's STRETCHES (dict), and the sides' worst error."""
    size = np.array([8e-3, 4e-3, 4e-3])
    vertices, tetrahedra = block((4, 2, 2), size)
    right = vertices[:, 0] > size[0] - 1e-9
    # A quarter of the bar: its planes of symmetry keep it from buckling.
    held = vertices < 1e-9
    held[right, 0] = True
    specimen = Specimen(vertices, tetrahedra, gel(poisson, law, young), held)
    ratios, sides = {}, 0.0
    for sign in (1, -1):
        stretches = sorted((s for s in STRETCHES[law] if sign * (s - 1) > 0), key=lambda s: sign * s)
        places = vertices.copy()
        reached = 1.0
        for stretch in stretches:
            # Pulled further at once, elements next to the grip turn inside out on the way.
            for part in np.linspace(reached, stretch, 1 + int(np.ceil(abs(stretch - reached) / 0.05)))[1:]:
                places[right, 0] = size[0] * part
                places, force = specimen.rest(places)
            reached = stretch
            expected, side = bar_stress(law, young, poisson, stretch)
            ratios[stretch] = float(-force[right, 0].sum() / (expected * size[1] * size[2]))
            width = places[:, 1].max() - places[:, 1].min()
            sides = max(sides, abs(float(width / size[1] / side) - 1))
    return dict(sorted(ratios.items())), sides


def sheet(length, width, spacing, jitter=0.2):
    """Irregular triangles of a rectangle: vertices (n, 3), m, z = 0, and triangles (m, 3)."""
    cells = np.maximum(np.round(np.array([length, width]) / spacing).astype(int), 1)
    grid = np.array(list(np.ndindex(*(cells + 1))), float)
    draw = np.random.default_rng(0).uniform(-jitter, jitter, grid.shape)
    draw[(grid == 0) | (grid == cells)] = 0
    plane = (grid + draw) * np.array([length, width]) / cells
    return np.insert(plane, 2, 0, axis=1), Delaunay(plane).simplices


def disc(radius, spacing, lattice="spiral"):
    """Triangles of a disc: vertices (n, 3), m, z = 0, the centre first; triangles (m, 3).

    lattice: `spiral`, as the tip's own skin, or `equilateral`. The last two rings of vertices lie at `radius` and outside.
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


def rigidity(materials):
    """Bending rigidity D of a plate of the skin, N m: E t^3 / (12 (1 - nu^2))."""
    return materials.skin_young_pa * materials.skin_thickness_m**3 / (12 * (1 - materials.skin_poisson**2))


def strip_ratios(materials, stretches=(0.8, 0.9, 1.1, 1.25)):
    """Force of a stretched strip of skin over the closed form of plane-stress St Venant-Kirchhoff, at each stretch: dict.

    It is that of the bar (`bar_stress`), times thickness. A quarter of the strip, kept flat, so that it does not buckle.
    """
    length, width = 20e-3, 8e-3
    vertices, triangles = sheet(length, width, 2e-3)
    right = vertices[:, 0] > length - 1e-9
    held = vertices < 1e-9
    held[right, 0] = True
    specimen = Specimen(vertices, triangles, skin_attributes(materials), held)
    out = {}
    for stretch in stretches:
        places = vertices * [stretch, 1, 1]
        _, force = specimen.rest(places)
        stress, _ = bar_stress("St Venant-Kirchhoff", materials.skin_young_pa, materials.skin_poisson, stretch)
        out[stretch] = float(-force[right, 0].sum() / (stress * width * materials.skin_thickness_m))
    return out


def curving_ratios(materials, spacing, lattice="spiral"):
    """Moment of a plate bent to given curvatures over Kirchhoff's: dict of `cylinder`, `sphere`, `saddle`.

    The shape is given, z = (a x^2 + b y^2)/2, and the energy's slope along it measured from the vertex forces. Kirchhoff:
    energy over area is D/2 ((a + b)^2 - 2 (1 - nu) a b). Two discs tell the area's energy from what the border lacks.
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


def cantilever_ratio(materials, spacing):
    """Deflection at the end of a strip clamped at the other over F L^3 / (3 E I): 20 by 6 mm, a small load."""
    length, width = 20e-3, 6e-3
    compliance = length**3 / (3 * materials.skin_young_pa * width * materials.skin_thickness_m**3 / 12)
    load = _SMALL_M / compliance
    vertices, triangles = sheet(length + spacing, width, spacing)
    vertices = vertices - [spacing, 0, 0]
    held = np.zeros(vertices.shape, bool)
    held[vertices[:, 0] < 0.3 * spacing] = True
    end = vertices[:, 0] > length - 1e-9
    force = np.zeros(vertices.shape)
    force[end, 2] = load / end.sum()
    places, _ = Specimen(vertices, triangles, skin_attributes(materials), held).rest(vertices, force, 2000, 1e-4)
    return float(places[end, 2].mean() / _SMALL_M)


def clamped_plate_ratio(materials, spacing, lattice="spiral"):
    """Deflection at the centre of a clamped circular plate under pressure over q a^4 / (64 D): radius 15 mm."""
    radius = 15e-3
    pressure = _SMALL_M * 64 * rigidity(materials) / radius**4
    vertices, triangles = disc(radius, spacing, lattice)
    held = np.repeat((np.hypot(*vertices[:, :2].T) > radius - 1e-9)[:, None], 3, 1)
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    area = np.zeros(len(vertices))
    for corner in triangles.T:
        np.add.at(area, corner, np.abs(np.cross(b - a, c - a)[:, 2]) / 6)
    load = np.outer(pressure * area, [0, 0, 1.0])
    places, _ = Specimen(vertices, triangles, skin_attributes(materials), held).rest(vertices, load, 2000, 1e-4)
    return float(places[0, 2] / _SMALL_M)


def dome_ratio(materials, resolution):
    """Deflection of the tip's own dome of skin, without gel, under a point load at the apex over Reissner's.

    Reissner 1946, a shallow spherical shell: F R sqrt(3 (1 - nu^2)) / (4 E t^2). Half the difference of pull and push.
    Also returns how far, m, its vertices move without a load: the bending of a curved skin is not quite at rest.
    """
    mesh = build_mesh(TipGeometry(), resolution)
    vertices = mesh.vertices[: mesh.surface_count]
    held = np.repeat(mesh.bonded[: mesh.surface_count, None], 3, 1)
    apex = np.hypot(*vertices[:, :2].T).argmin()
    radius = np.linalg.norm(vertices[apex] - mesh.centre)
    radial = (vertices[apex] - mesh.centre) / radius
    young, nu, t = materials.skin_young_pa, materials.skin_poisson, materials.skin_thickness_m
    load = _SMALL_M / (radius * np.sqrt(3 * (1 - nu**2)) / (4 * young * t**2))
    specimen, force, moved = (
        Specimen(vertices, mesh.triangles, skin_attributes(materials), held),
        np.zeros(vertices.shape),
        [],
    )
    for sign in (1, -1):
        force[apex] = sign * load * radial
        places, _ = specimen.rest(vertices, force, 2000, 1e-4)
        moved.append(places - vertices)
    unloaded = np.linalg.norm(moved[0] + moved[1], axis=1).max() / 2
    return float((moved[0] - moved[1])[apex] @ radial / 2 / _SMALL_M), float(unloaded)


def measure():
    """All of it: a dict for docs/materials.json."""
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
    options.out.mkdir(parents=True, exist_ok=True)
    write_file(options.out / "materials.json", (json.dumps(result, indent=1) + "\n").encode())
    write_file(options.out / "materials.md", page(result).encode())
    return result


def page(result):
    """The Markdown (str) of a result."""
    lines = [
        "# The materials against closed forms",
        "",
        "Written by `tactip bench materials`; do not edit. Small bodies of their own, "
        "with the settings of "
        "`tactip_model/soft_body.py`. The sources of the closed forms stand in `benchmarks/physics/materials.py`.",
        "",
        "## Gel: linear tetrahedra",
        "",
        "*Patch test*: the surface of an irregular block of 384 tetrahedra is moved affinely; inner vertices must follow. "
        "Their greatest error over the block's size, Poisson's ratio 0.45:",
        "",
        "| law | " + " | ".join(PATCHES) + " |",
        "|---|" + "---|" * len(PATCHES),
    ]
    for law, errors in result["patch"].items():
        lines.append(f"| {law} | " + " | ".join(f"{e:.0e}" for e in errors.values()) + " |")
    lines += [
        "",
        "*Bar* with free sides, pulled and pressed: greatest error of force and of its sides' stretch against the law's "
        "closed form (St Venant-Kirchhoff's force falls again below a stretch of 0.577: it is no law for a pressed gel):",
        "",
        "| law | Poisson's ratio | stretch | force | sides |",
        "|---|---|---|---|---|",
    ]
    for row in result["bar"]:
        ratios = {float(k): v for k, v in row["force_ratio"].items()}
        worst = max(abs(r - 1) for r in ratios.values())
        lines.append(
            f"| {row['law']} | {row['poisson']} | {min(ratios)} to {max(ratios)} | {worst:.0e} | "
            f"{row['worst_side_error']:.0e} |"
        )
    worst = max(abs(r - 1) for r in result["strip"].values())
    sizes = list(result["cantilever"])
    lines += [
        "",
        "## Skin: stretching and bending triangles",
        "",
        f"*Stretching*: a strip pulled and pressed by up to a quarter, kept flat, is within {worst:.0e} of plane-stress St "
        "Venant-Kirchhoff in force.",
        "",
        "*Bending*, measured over the closed form. `spiral`: points as on the tip's skin. Spacing, mm:",
        "",
        "| what | over | mesh | " + " | ".join(sizes) + " |",
        "|---|---|---|" + "---|" * len(sizes),
    ]
    for lattice, by_size in result["curving"].items():
        for shape in ("cylinder", "sphere", "saddle"):
            cells = " | ".join(f"{by_size[size][shape]:.2f}" for size in sizes)
            lines.append(f"| moment, bent to a {shape} | Kirchhoff's plate | {lattice} | {cells} |")
    for lattice, by_size in result["clamped_plate"].items():
        cells = " | ".join(f"{by_size[size]:.2f}" for size in sizes)
        lines.append(f"| deflection of a clamped disc of 15 mm | q a⁴ / 64 D | {lattice} | {cells} |")
    cells = " | ".join(f"{result['cantilever'][size]:.2f}" for size in sizes)
    lines += [
        f"| deflection of a strip, 20 by 6 mm | F L³ / 3 E I | jittered squares | {cells} |",
        "",
        f"A triangle mesh bends at its edges, which knows no Poisson's ratio. Moments over the plate's: {_curved(result)}. "
        "No factor on thickness or modulus mends all. On the tip's own dome stretching and bending share the load: the skin "
        "alone under a point load at its apex, deflection over Reissner's for a spherical shell,",
        "",
        "| mesh | deflection | moves without a load, mm |",
        "|---|---|---|",
    ]
    for name, row in result["dome"].items():
        lines.append(f"| {name} | {row['deflection_ratio']:.2f} | {row['unloaded_mm']:.4f} |")
    lines += [
        "",
        "The last column: the bending of a curved skin is not quite at rest as built.",
    ]
    return "\n".join(lines) + "\n"


def _curved(result):
    """Ranges of the moments of curving_ratios over spacings, by shape and mesh, in words."""
    told = []
    for shape, kind in (("cylinder", "cylinders"), ("sphere", "domes"), ("saddle", "saddles")):
        ranges = []
        for lattice, by_size in result["curving"].items():
            found = [row[shape] for row in by_size.values()]
            ranges.append(f"{min(found):.2f} to {max(found):.2f} ({lattice})")
        told.append(f"{kind} {' and '.join(ranges)}")
    return ", ".join(told)
