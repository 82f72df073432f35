"""A simulated TacTip in a few lines: press it on an object, and get the contact's image, pins and force.

The record of every press is checked, and the press is repeated with finer steps if a check fails. If no try passes, an
error is raised.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from os import PathLike, fspath
from pathlib import Path

import numpy as np
import trimesh

from tactip_twin.sim.contact.fidelity import Fidelity, fidelity_named
from tactip_twin.sim.contact.press_place import in_contact_frame, place_below
from tactip_twin.sim.contact.record import Contact, QualityLimits
from tactip_twin.sim.contact.retries import RetryingSimulator
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.contact.stimuli import STIMULI, Stimulus, stimulus_named
from tactip_twin.sim.labels import FidelityName
from tactip_twin.sim.pose import from_mm_deg, sensor_in_contact
from tactip_twin.sim.robot.objects import SceneObject, load_object
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import load_design
from tactip_twin.tactip_model.renderer import RendererName, renderer_named
from tactip_twin.tactip_model.tactile_image import tactile_image

Pressable = str | PathLike[str] | Stimulus | SceneObject | trimesh.Trimesh
"""Objects that a tip can be pressed on: a stimulus by name or as an object, a mesh file (mm), an object of `load_object`,
or a mesh (m)."""


class UntrustedContact(TactipError):
    """Error for a contact whose record failed its checks in every try; `record` is the last one."""

    def __init__(self, message: str, record: Contact) -> None:
        super().__init__(message)
        self.record = record


class TactileContact:
    """One finished contact: the sensor's images, its pins and the force on it."""

    def __init__(self, tip: "TacTip", record: Contact, force: np.ndarray, tries: int) -> None:
        """Args:
        tip: The sensor.
        record: The contact, in SI units and the sensor frame.
        force: (3,) N, of the object on the tip, in the contact frame.
        tries: Number of simulations until the record passed its checks.
        """
        self._tip = tip
        self.record = record
        self.force_N = force
        self.tries = tries

    @property
    def pins_mm(self) -> np.ndarray:
        """Pin tips (p, 3), mm, sensor frame."""
        return 1e3 * self.record.pin_tips

    @cached_property
    def frame(self) -> np.ndarray:
        """The camera's grey frame (h, w) uint8. Raises TactipError if the renderer cannot be used."""
        return self._tip.render(self.record.pin_tips, self.record.directions)

    @cached_property
    def image(self) -> np.ndarray:
        """The binary tactile image (size, size) uint8, 0 and 255. Raises TactipError if the renderer cannot be used."""
        return tactile_image(self.frame, self._tip.design.image)


class TacTip:
    """A simulated TacTip."""

    def __init__(
        self,
        design: str | PathLike[str] | Design = "tactip-127",
        fidelity: FidelityName | Fidelity = "standard",
        renderer: RendererName = "pyrender",
        limits: QualityLimits | None = None,
    ) -> None:
        """Args:
            design: A preset's name (tactip-127, tactip-331, nominal-127, nominal-331), a design file, or a Design.
            fidelity: draft, standard or reference, or a Fidelity.
            renderer: pyrender, or raster, which needs no OpenGL. It is started for the first image.
            limits: Limits of the checks of a contact's record.

        Raises:
            TactipError: A name is unknown, or the file holds no design.
        """
        self.design = design if isinstance(design, Design) else load_design(fspath(design))
        self.fidelity = fidelity if isinstance(fidelity, Fidelity) else fidelity_named(fidelity)
        self._renderer: RendererName = renderer
        self._limits = limits or QualityLimits()
        self._key: tuple[object, ...] | None = None
        self._pressed_on: Pressable | None = None
        self._simulator: RetryingSimulator | None = None

    @cached_property
    def render(self) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """Function that renders pin tips (p, 3), m, and directions (p, 3) as the camera's grey frame (h, w) uint8."""
        return renderer_named(self._renderer, self.design)

    @cached_property
    def neutral_image(self) -> np.ndarray:
        """The tactile image (size, size) uint8 of the undeformed tip."""
        return tactile_image(self.render(*neutral_pins(self.design)), self.design.image)

    @property
    def neutral_pins_mm(self) -> np.ndarray:
        """Pin tips (p, 3) of the undeformed tip, mm, sensor frame."""
        return 1e3 * neutral_pins(self.design)[0]

    def press(
        self,
        stimulus: Pressable = "surface",
        *,
        depth_mm: float = 3.0,
        x_mm: float = 0.0,
        y_mm: float = 0.0,
        roll_deg: float = 0.0,
        pitch_deg: float = 0.0,
        yaw_deg: float = 0.0,
        shear_mm: Sequence[float] = (0.0, 0.0),
        shear_deg: Sequence[float] = (0.0, 0.0, 0.0),
        at_mm: tuple[float, float] | None = None,
    ) -> TactileContact:
        """Press the tip on a stimulus and shear it to a pose.

        The pose is the sensor's in the contact frame: z along the outward normal, x off an edge, y along it (sim/pose.py).
        On a mesh, the contact frame is where a vertical line through `at_mm` meets the surface from above.

        Args:
            stimulus: Name of a stimulus, a mesh file in mm, or an object: see Pressable.
            depth_mm: Depth of the apex below the surface, mm.
            x_mm: Position perpendicular to the edge, mm, positive off the object.
            y_mm: Position along the edge, mm.
            roll_deg: Rotation vector's x, degrees.
            pitch_deg: Rotation vector's y, degrees.
            yaw_deg: Rotation vector's z, degrees.
            shear_mm: (2,) or (3,) motion in contact before the pose, mm.
            shear_deg: (3,) rotation vector of that motion, degrees.
            at_mm: x and y of the contact on a mesh, mm, in its frame (of an object, the base frame); the middle if None.

        Returns:
            The contact; its record passed its checks.

        Raises:
            UntrustedContact: The record failed its checks in every try; the message says which.
            TactipError: The stimulus is unknown or unfit, or the pose is out of reach.
        """
        if len(shear_mm) not in (2, 3) or len(shear_deg) != 3:
            raise TactipError(
                f"shear_mm must be 2 or 3 numbers and shear_deg 3 numbers, got {tuple(shear_mm)} and {tuple(shear_deg)}"
            )
        require(depth_mm >= 0, "depth_mm", depth_mm, "at least 0: it is positive into the object")
        pose = from_mm_deg([x_mm, y_mm, -depth_mm, roll_deg, pitch_deg, yaw_deg])
        shear = from_mm_deg([*shear_mm, *[0.0] * (3 - len(shear_mm)), *shear_deg])
        simulator = self._simulator_for(stimulus, at_mm)
        record, failures = simulator.simulate(pose, shear)
        if len(failures) == simulator.tries:
            raise UntrustedContact(
                f"the contact failed its checks in {simulator.tries} tries: {'; '.join(failures[-1])}", record
            )
        force = sensor_in_contact(pose)[:3, :3] @ simulator.last.scene.contact_force()
        return TactileContact(self, record, force, len(failures) + 1)

    def _simulator_for(self, stimulus: Pressable, at_mm: tuple[float, float] | None) -> RetryingSimulator:
        """Return the simulator of a stimulus. That of the last press is kept, because building one is slow."""
        name = str(stimulus) if isinstance(stimulus, str | PathLike) else None
        changed = Path(name).stat().st_mtime_ns if name and Path(name).is_file() else 0
        # An object without a name is known by its identity; holding it keeps the identity from being used again.
        key = (name or id(stimulus), changed, at_mm)
        if self._simulator is None or self._key != key:
            self._simulator = RetryingSimulator(self.design, _stimulus_of(stimulus, at_mm), self.fidelity, self._limits)
            self._key, self._pressed_on = key, stimulus
        return self._simulator


def _stimulus_of(stimulus: Pressable, at_mm: tuple[float, float] | None) -> Stimulus:
    if isinstance(stimulus, Stimulus) or (isinstance(stimulus, str) and stimulus in STIMULI):
        if at_mm is not None:
            raise TactipError(f"at_mm must be None with a stimulus that is not a mesh, got {at_mm}: give x_mm and y_mm")
        return stimulus if isinstance(stimulus, Stimulus) else stimulus_named(stimulus)
    if isinstance(stimulus, str | PathLike) and not Path(stimulus).is_file():
        raise TactipError(f"unknown stimulus {str(stimulus)!r}: choose one of {', '.join(STIMULI)}, or a mesh file")
    if isinstance(stimulus, SceneObject):
        T, solid = stimulus.T_base_object, stimulus.solid
        vertices, middle = solid.vertices @ T[:3, :3].T + T[:3, 3], stimulus.middle_m[:2]
    else:
        source = stimulus if isinstance(stimulus, trimesh.Trimesh) else Path(stimulus)
        solid = load_object(source).solid
        vertices, middle = solid.vertices, (solid.vertices.min(0) + solid.vertices.max(0))[:2] / 2
    if at_mm is not None:
        middle = np.array(at_mm) / 1e3
    return _from_above(SignedDistanceMesh(vertices, solid.triangles), middle)


def _from_above(solid: SignedDistanceMesh, at: np.ndarray) -> SolidStimulus:
    """Return a solid as a stimulus whose contact frame is where a vertical line at (2,) m meets it from above."""
    place = place_below(solid, at)
    if place is None:
        raise TactipError(
            f"at_mm must lie on the mesh, which has no surface below x, y = {1e3 * at[0]:g}, {1e3 * at[1]:g} mm"
        )
    return SolidStimulus(in_contact_frame(solid, place))
