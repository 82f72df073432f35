"""Import of frames: the camera's change, videos, and frames that cannot be used as they are."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from helpers.laboratory import DESIGN, SIZE, bring, frame, redraw, with_rim, write_set, write_table
from tactip_twin.commands import main as tactip
from tactip_twin.sim.dataset.format import read_dataset
from tactip_twin.sim.view.video import write_video
from tactip_twin.sim2real.importing import import_set as importing
from tactip_twin.sim2real.transfer.neutral_calibration import fit_design_to_neutral_image
from tactip_twin.tactip_model.neutral_image import neutral_px


def lit_all_round(image, zoom=1.0, right_px=0.0):
    """The frame with six arcs of light round it, as large and as far to the right as a camera that grew warm sees them."""
    lit, fine = image.copy(), 1 << 4
    centre, radius = round((SIZE / 2 + right_px) * fine), round(120 * zoom * fine)
    for start in range(0, 360, 60):
        cv2.ellipse(lit, (centre, SIZE // 2 * fine), (radius, radius), 0, start, start + 40, 255, 4, cv2.LINE_AA, 4)
    return np.where(lit > 127, 255, 0).astype(np.uint8)


def test_import_measures_camera_change_from_rim(tmp_path, capsys, monkeypatch):
    write_set(tmp_path / "lab")
    cv2.imwrite(str(tmp_path / "lab" / "init_0.png"), lit_all_round(frame()))
    for k in range(12):
        cv2.imwrite(str(tmp_path / "lab" / "images" / f"frame_{k}.png"), lit_all_round(frame(1 + 0.005 * k), 1.02, 1.0))
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    assert "reflections at the rim: image scale 1.0" in capsys.readouterr().out
    camera = json.loads((tmp_path / "set" / "import.json").read_text())["camera"]
    assert camera["zoom"] == pytest.approx(1.02, abs=0.003)
    assert camera["drift"] == pytest.approx([1 / SIZE, 0.0], abs=0.001)
    # One that an earlier version imported, which did not look, is imported anew.
    meta = (tmp_path / "set" / "meta.json").read_bytes()
    report = json.loads((tmp_path / "set" / "import.json").read_text())
    del report["camera"]
    (tmp_path / "set" / "import.json").write_text(json.dumps(report))
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    assert "whose report is incomplete" in capsys.readouterr().out
    assert (tmp_path / "set" / "meta.json").read_bytes() == meta
    # And if that is stopped before its end, it is no set until the command is run again.
    (tmp_path / "set" / "import.json").write_text(json.dumps(report))
    with monkeypatch.context() as patch:
        patch.setattr(importing, "encode_image", lambda image: (_ for _ in ()).throw(KeyboardInterrupt))
        assert bring(tmp_path / "lab", tmp_path / "set") == 130
    assert not (tmp_path / "set" / "meta.json").exists()
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    assert (tmp_path / "set" / "meta.json").read_bytes() == meta
    # The twin has it, and the pins that the neutral image shows are where they were when that was taken.
    design, figures = fit_design_to_neutral_image(tmp_path / "set", 128)
    assert figures["camera"] == camera and design.optics.zoom == camera["zoom"]
    then = replace(design, optics=replace(design.optics, zoom=1.0, drift=(0.0, 0.0)))
    assert np.abs(neutral_px(then) - neutral_px(DESIGN)).max() < 0.6


def test_import_too_little_light_leaves_camera_unknown(tmp_path, capsys):
    write_set(tmp_path / "lab")  # one arc of light
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    assert "too little light at the rim" in capsys.readouterr().out
    assert json.loads((tmp_path / "set" / "import.json").read_text())["camera"] is None
    assert fit_design_to_neutral_image(tmp_path / "set", 128)[0].optics.zoom == 1.0


def test_import_unusable_frames_are_left_out_and_named(tmp_path, capsys):
    rows = write_set(tmp_path / "lab")
    images = tmp_path / "lab" / "images"
    (images / "frame_1.png").unlink()
    (images / "frame_2.png").write_bytes(b"no image")
    cv2.imwrite(str(images / "frame_3.png"), np.zeros((SIZE, SIZE), np.uint8))
    cv2.imwrite(str(images / "frame_4.png"), np.zeros((SIZE, 300), np.uint8))
    rows[5]["pose_2"] = ""
    write_table(tmp_path / "lab", rows)
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    report = json.loads((tmp_path / "set" / "import.json").read_text())
    assert report["kept"] == 7
    why = {one["frame"]: one["why"] for one in report["left_out"]}
    assert why["frame_1.png"] == "the file does not exist"
    assert why["frame_2.png"] == "it cannot be read as an image"
    assert why["frame_3.png"] == "0 pins detected, the median is 127"
    assert why["frame_4.png"] == "it must be 256×256 px like the neutral image, got 300×256 px"
    assert why["frame_5.png"] == "its row has a value that is not a finite number"
    assert tactip.main(["dataset", "verify", str(tmp_path / "set")]) == 0


def test_import_videos_instead_of_frames(tmp_path, capsys):
    """Each row's video shows the tip at rest, except in its middle frame; videos are compressed, as those of cameras are."""
    rows = write_set(tmp_path / "lab")
    assert bring(tmp_path / "lab", tmp_path / "frames") == 0
    (tmp_path / "lab" / "images").rename(tmp_path / "lab" / "stills")
    (tmp_path / "lab" / "videos").mkdir()
    for k, row in enumerate(rows):
        still = cv2.imread(str(tmp_path / "lab" / "stills" / row.pop("image_name")))
        rest = cv2.cvtColor(with_rim(frame()), cv2.COLOR_GRAY2RGB)
        write_video(tmp_path / "lab" / "videos" / f"video_{k}.mp4", [rest, still, rest], 10)
        row["sensor_video"] = f"video_{k}.mp4"
    write_table(tmp_path / "lab", rows)
    assert bring(tmp_path / "lab", tmp_path / "videos", "--video-frame", "1") == 0
    videos, frames = (read_dataset(tmp_path / name) for name in ("videos", "frames"))
    assert np.array_equal(videos.poses, frames.poses)
    for i in range(len(rows)):
        assert (videos.image(i) != frames.image(i)).mean() < 0.01
    # By default the last frame, which here shows the tip at rest.
    assert bring(tmp_path / "lab", tmp_path / "last") == 0
    last = read_dataset(tmp_path / "last")
    apart = [(each.image(0) != each.image(1)).mean() for each in (last, videos)]
    assert apart[0] < 0.001 and apart[1] > 0.01
    capsys.readouterr()
    assert bring(tmp_path / "lab", tmp_path / "none", "--video-frame", "3") == 1
    assert "the video has no frame 3 (0 is the first, -1 the last)" in capsys.readouterr().err


def test_import_grey_frames_suggest_threshold(tmp_path, capsys):
    write_set(tmp_path / "lab")
    redraw(tmp_path / "lab", lambda image: (60 + 0.5 * image).astype(np.uint8))
    assert bring(tmp_path / "lab", tmp_path / "set") == 1
    output = capsys.readouterr().err
    assert "are neither black nor white" in output and "give --threshold 43 -5" in output
    assert not (tmp_path / "set").exists()
    assert bring(tmp_path / "lab", tmp_path / "set", "--threshold", "43", "-5") == 0
    assert "pins: median 127" in capsys.readouterr().out


def test_import_wide_frame_suggests_crop(tmp_path, capsys):
    write_set(tmp_path / "lab")
    redraw(tmp_path / "lab", lambda image: np.pad(image, ((20, 30), (150, 40))))
    assert bring(tmp_path / "lab", tmp_path / "set") == 1
    output = capsys.readouterr().err
    assert "must be square, got 446×306 px: give --crop " in output
    crop = output.split("--crop ")[1].split(",")[0].split()
    # The pins in the middle, as they were before the frames were made wide.
    assert np.allclose(np.array(crop, int), [150, 20, 150 + SIZE, 20 + SIZE], atol=6)
    assert bring(tmp_path / "lab", tmp_path / "set", "--crop", *crop) == 0
    assert "pins: median 127, 127 to 127" in capsys.readouterr().out
