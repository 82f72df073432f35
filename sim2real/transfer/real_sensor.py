"""Design of the sensor of a real set, for contacts like its own: given, or fitted to its neutral image, with the pitch of
its pins and the materials that its frames show."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.learning.data import Samples
from tactip_twin.learning.image_check import MAX_APART_PX, pins_apart_px
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS
from tactip_twin.sim.labels import Task
from tactip_twin.sim2real.importing.frame_blobs import blobs_of, read_blobs
from tactip_twin.sim2real.importing.import_set import pins_at_rest
from tactip_twin.sim2real.transfer.estimated_mechanics import AFTER, BEFORE, estimated_mechanics
from tactip_twin.sim2real.transfer.gel import with_usual_gel
from tactip_twin.sim2real.transfer.neutral_calibration import camera_of, fit_design_to_neutral_image, with_camera_drift
from tactip_twin.sim2real.transfer.settings import AUTO, TransferSettings
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.design_file import design_as_dict, read_design, write_design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import read_json
from tactip_twin.tactip_model.presets import load_design

_MAX_RESIDUAL = 0.75
"""Largest distance of the pins with estimated materials, as a fraction of that with usual ones, for them to be believed. It
is 0.4 to 0.5 on hidden sensors with other mechanics, and 0.85 to 0.9 on real-127 and real-331, on which narrow mechanics
around the estimate made depth 0.01 mm worse or changed nothing [M]."""

_METHOD = "pitch and materials together"
"""Name of the way to estimate, so that what an earlier version has estimated in another way is estimated again."""

_MATERIALS, _INPUTS = "estimated_materials", "inputs_sha256"
"""Names in the provenance of a design: what was found of the materials, or null; checksum of all that the design was
estimated from."""


class RealSensor:
    """Sensor of a real set. Its design is found when it is first asked for, and kept in a file for later commands."""

    def __init__(
        self,
        real: Path,
        out: Path,
        settings: TransferSettings,
        frames: Samples,
        task: Task,
        log: Callable[[str], None],
    ) -> None:
        """Read the design that the settings name, if they do.

        Args:
            real: Folder of an imported set.
            out: Folder for design.json, what was found.
            settings: Settings of the experiments.
            frames: Samples of the set from which pitch and materials are estimated.
            task: Their stimulus.
            log: Callback for messages to the user.

        Raises:
            TactipError: The named design cannot be read.
        """
        self._real, self._out, self._settings, self._log = real, out, settings, log
        self._size_px, self._frames = frames.size, frames
        self._task: Task = task
        self._given = load_design(settings.design) if settings.design else None
        self._fitted: Design | None = None
        self._estimated = False

    def design(self) -> Design:
        """Return the given design, or one fitted to the neutral image.

        Raises:
            TactipError: The given one is of another sensor or camera, the neutral image shows no pins, or the set's blobs
                cannot be read.
        """
        if self._given:
            self._check_given(self._given)
            design = with_camera_drift(self._given, camera_of(self._real))
            return replace(design, image=replace(design.image, size_px=self._size_px))
        if self._fitted is None:
            self._fitted = self._found()
        return self._fitted

    def mechanics(self) -> str:
        """Return the name of the randomization of mechanics that suits the design. Raises TactipError as `design`."""
        if self._given:
            return "real"
        self.design()
        return "estimated" if self._estimated else "real"

    def _found(self) -> Design:
        """Return the design that neutral image and frames show; that of an earlier command if it was estimated from them."""
        self._log("fitting tip and camera to the neutral image")
        fitted, figures = fit_design_to_neutral_image(self._real, self._size_px)
        fitted = with_usual_gel(fitted)
        blobs = self._blobs()
        inputs, path = self._checksum(fitted, blobs), self._out / "design.json"
        if path.exists() and (kept := self._kept(path, inputs)):
            self._log(f"pitch and materials are those in {path}, which were estimated from the same frames")
            return kept
        fitted, found = self._with_mechanics(fitted, blobs)
        self._out.mkdir(parents=True, exist_ok=True)
        write_design(path, fitted, {"neutral_image_of": self._real.name} | found | figures | {_INPUTS: inputs})
        return fitted

    def _blobs(self) -> list[np.ndarray]:
        """Return the centres (k, 2) of the blobs, px of 256, of the frames that the import has kept at full size; of the
        tactile images if it has kept none."""
        kept = read_blobs(self._real, self._frames.dataset.meta) or {}
        known = set(self._frames.rows.tolist())
        shown = [centres for row, centres in kept.items() if row in known]
        return shown or [blobs_of(image) for image in self._frames.images]

    def _checksum(self, fitted: Design, blobs: Sequence[np.ndarray]) -> str:
        """Return a checksum of all that pitch and materials are estimated from."""
        name = self._settings.randomize_mechanics
        of_materials = name if name in (AUTO, "estimated") else None
        counts = [len(centres) for centres in blobs]
        record = [_METHOD, design_as_dict(fitted), self._task, self._settings.seed, of_materials, counts]
        return hashlib.sha256(json.dumps(record).encode() + b"".join(one.tobytes() for one in blobs)).hexdigest()

    def _kept(self, path: Path, inputs: str) -> Design | None:
        """Return the design in a file; None if it was estimated from other inputs or is damaged."""
        try:
            design, provenance = read_design(path), read_json(path)["provenance"]
        except TactipError as error:
            self._log(f"pitch and materials are estimated again: {error}")
            return None
        if provenance.get(_INPUTS) != inputs:
            return None
        self._estimated = provenance.get(_MATERIALS) is not None
        return design

    def _check_given(self, design: Design) -> None:
        """Raise TactipError if a design's pins are not where the set's neutral image has them."""
        pins = pins_at_rest(self._real)
        apart = 0.0 if pins is None else pins_apart_px(design, pins)
        if apart > MAX_APART_PX:
            raise TactipError(
                f"the pins of the design {design.name!r} must be within {MAX_APART_PX:g} px of 256 of those in the neutral "
                f"image, got {apart:.1f} px: give the design that tactip calibrate has fitted to this sensor, or none"
            )

    def _with_mechanics(self, design: Design, blobs: Sequence[np.ndarray]) -> tuple[Design, dict[str, Any]]:
        """Return a design with the pitch that the frames show, and with the materials if these are to be
        estimated and are believed; and what was estimated, for the design's provenance."""
        name, around = self._settings.randomize_mechanics, MECHANICS_RANDOMIZATIONS["estimated"]
        self._log("estimating pitch and materials from the pins of some frames")
        try:
            found = estimated_mechanics(design, blobs, self._task, around, self._settings.seed)
        except TactipError as error:
            if name == "estimated":
                raise
            self._log(f"the pitch remains {1e3 * design.pins.pitch_m:.2f} mm, and the materials vary more: {error}")
            return design, {_MATERIALS: None}
        pitches = (1e3 * one.pins.pitch_m for one in (found.with_pitch, design))
        self._log("the pitch is {:.2f} mm; usual is {:.2f} mm".format(*pitches))
        before, after = (found.materials[key] for key in (BEFORE, AFTER))
        shown = {"distances_px": {BEFORE: before, AFTER: after}}
        if name not in (AUTO, "estimated"):
            return found.with_pitch, {_MATERIALS: None} | shown
        if name == AUTO and after > _MAX_RESIDUAL * before:
            self._log(
                f"the materials vary more, because none explain the pins much better: {after:.2f} px of 256 from the "
                f"frames, {before:.2f} px with usual ones"
            )
            return found.with_pitch, {_MATERIALS: None} | shown
        self._estimated = True
        return found.with_materials, {_MATERIALS: found.materials} | shown
