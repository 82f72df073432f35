"""The simulated 127-pin tip compared with the real one: `tactip bench real-comparison`.

The real sensor is represented by measurements on its public images (Tac-VGNN's 127-pin surface set): the pin map and blob
sizes of its neutral image, and the outward displacement of its pins at five depths. The frames themselves are not ours to
distribute, so real images are drawn from these measurements at the size of the simulated ones; with --real DIR (a folder
with init_0.png) the figure shows that frame, for private use. Writes docs/real_and_simulated.png and logs the errors.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from tactip_twin.benchmarks.learning.options import RealComparisonOptions
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim.view.plot import COLORS, figure_of, save_figure
from tactip_twin.tactip_model.design import Design, Pins
from tactip_twin.tactip_model.design_file import read_design_with_drift
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import neutral_px, reference_pixels
from tactip_twin.tactip_model.optics import REFERENCE_PX, Lens
from tactip_twin.tactip_model.pins import LATTICES, neutral_pins
from tactip_twin.tactip_model.presets import FITTED
from tactip_twin.tactip_model.pyrender_renderer import PinCamera
from tactip_twin.tactip_model.tactile_image import tactile_image

DEPTHS_MM = (1.25, 2.25, 3.25, 4.25, 4.75)
SHELLS = (1, 3, 4, 7, 9, 12, 13, 16, 19, 21, 25, 27, 28, 31, 36)
"""N = i² + ij + j² of the hexagonal lattice."""

REAL_OUTWARD_PX = np.array(
    [
        [1.39, 1.51, 1.37, 1.29, 1.18, 1.00, 0.89, 1.04, 1.04, 0.94, 0.94, 0.99, 1.00, 1.02, 1.04],
        [2.04, 3.11, 3.22, 3.13, 2.80, 2.40, 2.26, 2.14, 2.00, 1.87, 1.73, 1.76, 1.72, 1.67, 1.47],
        [2.60, 4.17, 4.58, 5.32, 5.13, 4.49, 4.23, 3.93, 3.55, 3.29, 3.00, 2.90, 2.88, 2.68, 2.13],
        [3.13, 5.09, 5.69, 7.09, 7.36, 7.01, 6.75, 6.22, 5.62, 5.21, 4.58, 4.45, 4.40, 3.97, 3.01],
        [3.47, 5.61, 6.30, 7.97, 8.54, 8.55, 8.32, 7.68, 6.98, 6.46, 5.72, 5.50, 5.41, 4.86, 3.61],
    ]
)
"""Measured: outward displacement, px of a 256 px image, of each shell's pins at each depth (offset known to 0.5 mm)."""

SHEARS_MM = (0.5, 1.5, 2.5, 3.5, 4.5)

REAL_SHIFT_PX = np.array(
    [
        [0.1, 0.4, 0.5, 0.5, 0.5],
        [0.1, 0.5, 1.1, 1.2, 1.3],
        [0.5, 1.2, 1.9, 1.7, 1.8],
        [1.0, 2.4, 3.3, 3.2, 2.3],
        [0.4, 3.0, 3.6, 4.2, 4.2],
    ]
)
"""Measured: mean shift of the pin field along the shear, px of 256, at each depth for shears of 0–1, 1–2, … 4–5 mm."""


PICTURE = "real_and_simulated.png"
"""File name of the picture."""

MOVE_FRACTIONS = np.linspace(0, 1, 6)
"""Fractions of the motion at which a frame may have been taken: real frames lag behind their commanded poses, evenly
distributed between none and all of the motion (docs/your-own-sensor.md)."""

OFFSETS_MM = np.arange(-0.5, 0.51, 0.25)
"""Depth offsets that are tried, mm: it is known to 0.5 mm."""


def shells(pins: Pins) -> np.ndarray:
    """Return N of each pin (p,) in a hexagonal layout."""
    return np.rint((LATTICES[pins.layout](pins.rings) ** 2).sum(1)).astype(int)


def at_rest(design: Design) -> Design:
    """Return the design with the camera as it was when the neutral image was taken."""
    return replace(design, optics=replace(design.optics, zoom=1.0, drift=(0.0, 0.0)))


def simulated_outward_px(simulator: ContactSimulator, depths_mm: np.ndarray) -> tuple[np.ndarray, list[Contact]]:
    """Return the simulated outward displacements (n, 15) px at depths (n,) mm, and the contacts."""
    design = simulator.scene.design
    lens, n, neutral = Lens(design), shells(design.pins), neutral_px(at_rest(design))
    outward = neutral - neutral[n == 0]
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    contacts = [simulator.simulate(from_mm_deg([0, 0, -d, 0, 0, 0]), np.zeros(6)) for d in depths_mm]
    moved = [((reference_pixels(lens.project(c.pin_tips), lens.width) - neutral) * outward).sum(1) for c in contacts]
    return np.array([[m[n == s].mean() for s in SHELLS] for m in moved]), contacts


def best_offset(simulator: ContactSimulator) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the depth offset, mm, that fits the table best, the residual (5, 15) px there, and the residual without it."""
    depths = np.add.outer(np.array(DEPTHS_MM), OFFSETS_MM)
    table = simulated_outward_px(simulator, depths.ravel())[0].reshape(*depths.shape, len(SHELLS))
    residuals = table - REAL_OUTWARD_PX[:, None]
    fine = np.linspace(OFFSETS_MM[0], OFFSETS_MM[-1], 101)
    between = np.array([[np.interp(fine, OFFSETS_MM, column) for column in row.T] for row in residuals])
    best = (between**2).mean((0, 1)).argmin()
    return float(fine[best]), between[:, :, best], residuals[:, len(OFFSETS_MM) // 2]


def simulated_shift_px(simulator: ContactSimulator) -> tuple[np.ndarray, np.ndarray]:
    """Return the simulated shift of the pin field, (5, 5) px, depths by shears: after the move, and with lagging frames."""
    lens = Lens(simulator.scene.design)

    def shifts(depth: float, shear: float) -> np.ndarray:
        contacts = simulator.simulate_partial_shears(
            from_mm_deg([0, 0, -depth, 0, 0, 0]), from_mm_deg([shear, 0, 0, 0, 0, 0]), MOVE_FRACTIONS
        )
        x = [reference_pixels(lens.project(c.pin_tips), lens.width)[:, 0].mean() for c in contacts]
        return x[0] - np.array(x)

    table = np.array([[shifts(d, s) for s in SHEARS_MM] for d in DEPTHS_MM])
    return table[..., -1], table.mean(-1)


def measured_image(design: Design, outward_px: np.ndarray) -> np.ndarray:
    """Return a binary real image (256, 256) uint8, drawn from the measured pin map, displacements and blob sizes.

    Args:
        design: The fitted design, whose pin map is the measured one.
        outward_px: (15,), outward displacement of each shell, px.
    """
    n, pins = shells(design.pins), neutral_px(at_rest(design))
    outward = pins - pins[n == 0]
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    pins = pins + outward * np.interp(np.sqrt(n), [0, *np.sqrt(SHELLS)], [0, *outward_px])[:, None]
    diameter = np.interp(np.sqrt(n), [0, 3, 4, 5, 6], [4.35, 4.37, 4.61, 5.04, 5.50])
    image = np.zeros((REFERENCE_PX, REFERENCE_PX), np.uint8)
    for (x, y), d in zip(pins, diameter, strict=True):
        cv2.circle(image, (round(x * 16), round(y * 16)), round(d * 8), 255, -1, cv2.LINE_8, 4)
    return image


def simulated_image(design: Design, pin_tips: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the binary simulated image (256, 256) uint8 of pins."""
    frame = PinCamera(design).render(pin_tips, directions)
    return tactile_image(frame, replace(design.image, size_px=REFERENCE_PX))


def rms(values: np.ndarray) -> float:
    """Return the root mean square of an array."""
    return float(np.sqrt(np.mean(np.square(values))))


def run(options: RealComparisonOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure, plot real_and_simulated.png, and return the results; they also go to `log`."""
    design = read_design_with_drift(FITTED["tactip-127"])
    simulator = ContactSimulator(design, "surface", fidelity_named(options.fidelity))
    offset, residuals, without = best_offset(simulator)
    simulated, contacts = simulated_outward_px(simulator, np.array(DEPTHS_MM) + offset)
    for depth, row, contact in zip(DEPTHS_MM, residuals, contacts, strict=True):
        log(f"{depth:.2f} mm: {rms(row):.2f} px rms; {contact.normal_force_n:.2f} N")
    log(
        f"all depths: {rms(residuals):.2f} px rms of 256 with a depth offset of {offset:.2f} mm, "
        f"{rms(without):.2f} px without"
    )
    over, lagging = simulated_shift_px(simulator)
    log("mean pin shift under shears of 0.5, 1.5, 2.5, 3.5, 4.5 mm, px: after motion | lagging frames | real")
    for depth, *rows in zip(DEPTHS_MM, over, lagging, REAL_SHIFT_PX, strict=True):
        log(f"{depth:.2f} mm: " + " | ".join(" ".join(f"{x:.1f}" for x in row) for row in rows))
    off = [rms(shift - REAL_SHIFT_PX) for shift in (over, lagging)]
    log(f"errors: after motion {off[0]:.2f} px rms, lagging frames {off[1]:.2f} px rms")
    for depth in (1, 2, 3):
        force = simulator.simulate(from_mm_deg([0, 0, -depth, 0, 0, 0]), np.zeros(6)).normal_force_n
        log(f"normal force at {depth} mm: {force:.2f} N")

    rest, shown = at_rest(design), DEPTHS_MM.index(4.25)
    pressed, neutral_real = contacts[shown], measured_image(design, np.zeros(len(SHELLS)))
    if options.real is not None:
        frame = cv2.imread(str(options.real / "init_0.png"), cv2.IMREAD_GRAYSCALE)
        if frame is None:
            raise TactipError(f"--real must be a folder with the image init_0.png, got {options.real}")
        neutral_real = frame
    depth = f"pressed {DEPTHS_MM[shown]:g} mm"
    pictures = (
        (neutral_real, "real, undeformed"),
        (simulated_image(rest, *neutral_pins(rest)), "simulated, undeformed"),
        (measured_image(design, REAL_OUTWARD_PX[shown]), f"real, {depth}"),
        (simulated_image(design, pressed.pin_tips, pressed.directions), f"simulated, {depth}"),
    )
    figure, axes = figure_of(1, 5, (16, 3.9))
    for axis, (image, text) in zip(axes, pictures, strict=False):
        axis.imshow(image, cmap="gray", interpolation="nearest")
        axis.set_title(text)
        axis.axis("off")
    for k, depth_mm in enumerate(DEPTHS_MM):
        color = COLORS[k]
        axes[4].plot(np.sqrt(SHELLS), REAL_OUTWARD_PX[k], "o", color=color, ms=4)
        axes[4].plot(np.sqrt(SHELLS), simulated[k], "-", color=color, label=f"{depth_mm} mm")
    axes[4].set(xlabel="distance from the axis, pitches", ylabel="outward displacement, px of 256")
    axes[4].set_title("real (dots), simulated (lines)")
    figure.legend(*axes[4].get_legend_handles_labels(), loc="outside right center", title="depth")
    options.out.mkdir(parents=True, exist_ok=True)
    save_figure(figure, options.out / PICTURE)
    return {
        "offset_mm": offset,
        "outward_rms_px": rms(residuals),
        "outward_rms_px_without_offset": rms(without),
        "shift_rms_px_lagging": off[1],
        "shift_rms_px": off[0],
    }
