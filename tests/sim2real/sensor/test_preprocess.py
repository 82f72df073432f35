"""Frames become tactile images: masked, mirrored, rotated and thresholded."""

import cv2
import numpy as np
import pytest

from helpers.laboratory import DESIGN, frame, with_rim
from tactip_twin.sim2real.sensor.preprocess import FrameReader
from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mask import pin_area
from tactip_twin.tactip_model.pin_detection import find_blobs
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image


def test_mask_removes_light_at_rim_only(tmp_path):
    plain, lit = frame(1.08), with_rim(frame(1.08))
    reader = FrameReader(ImagePreprocessing(), with_rim(frame()))
    assert np.array_equal(reader.masked(lit), plain)
    assert not np.array_equal(FrameReader(ImagePreprocessing(mask="none"), with_rim(frame())).masked(lit), plain)
    # Without a neutral image, frames tell where the pins are.
    output = FrameReader(ImagePreprocessing(), None, [with_rim(frame(z)) for z in (1.0, 1.04, 1.1)])
    assert np.array_equal(output.masked(lit), plain)
    with pytest.raises(TactipError, match="at least 20 pins must be detected in an image, got 0"):
        pin_area([np.zeros((64, 64), np.uint8)])


def test_frame_reader_undoes_mirror_rotation_and_dark():
    upright = frame()
    assert len(find_blobs(upright).centres) == 127
    for turn in (90, 180, -90):
        given = np.ascontiguousarray(np.rot90(upright, -turn // 90)[:, ::-1])
        reader = FrameReader(ImagePreprocessing(mirror=True, dark_pins=True, mask="none"))
        assert not np.array_equal(reader.binary(255 - given), upright)
        # What was turned and then mirrored is mirrored back, and then turned back.
        reader = FrameReader(ImagePreprocessing(rotate_image_deg=turn, mirror=True, dark_pins=True, mask="none"))
        assert np.array_equal(reader.binary(255 - given), upright)
    # An angle between: there and back is where it was, to a pixel's rounding.
    turned = FrameReader(ImagePreprocessing(rotate_image_deg=30.0, mask="none")).binary(upright)
    back = FrameReader(ImagePreprocessing(rotate_image_deg=-30.0, mask="none")).binary(turned)
    assert (np.abs(back.astype(int) - upright) > 127).mean() < 0.01


def test_frame_reader_thresholds_grey_frames_as_simulation():
    grey = Raster(DESIGN).render(*neutral_pins(DESIGN))
    reader = FrameReader(ImagePreprocessing(threshold=(61, -5.0), mask="none"))
    assert np.array_equal(reader.read(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)), tactile_image(grey, DESIGN.image))
