"""Tactile images of random presses, as the learned tip of any materials predicts them."""

import numpy as np

from tactip_twin.learning.pose_from_pins import PinModel
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.fast_tip.fast_tip import PinDecoder, any_materials, read_fast_tip
from tactip_twin.sim.fast_tip.materials import material_inputs
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim2real.importing.frame_blobs import blobs_of
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

TIP = read_fast_tip(any_materials("surface"))


def blobs_in(images):
    """Return the centres of the blobs of tactile images (n, size, size), px of 256."""
    return [blobs_of(image) for image in images]


def frames_of(design, count=60):
    """Return tactile images (count, size, size) of random presses of a tip with a design on a surface."""
    decoder, rng = PinDecoder(design, TIP.modes), np.random.default_rng(1)
    model = PinModel(TIP, decoder, POSE_RANGES["surface"], SHEAR_RANGES)
    values = model.low + (model.high - model.low) * rng.uniform(0.1, 0.9, (count, len(model.low)))
    contacts = from_mm_deg(model.whole(values).reshape(-1, 2, 6))
    found = TIP.predict(decoder, contacts[:, 0], contacts[:, 1], material_inputs(design.materials))
    raster = Raster(design)
    frames = (raster.render(tips, towards) for tips, towards in zip(found.pin_tips, found.directions, strict=True))
    return np.stack([tactile_image(frame, design.image) for frame in frames])
