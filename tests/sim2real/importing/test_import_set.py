"""Sets of real sensors come in: frames as a rig might have written them, drawn here, and all that may be wrong with them."""

import csv
import json
import os
from dataclasses import replace

import cv2
import numpy as np
import pytest

from helpers.kills import Killed, contents
from tactip_twin.commands import main as tactip
from tactip_twin.learning.data import read_samples
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.format import read_dataset
from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim.view.video import write_video
from tactip_twin.sim2real.importing import import_set as importing
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.sensor import preprocess
from tactip_twin.sim2real.sensor.preprocess import FrameReader
from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing
from tactip_twin.sim2real.transfer.neutral_calibration import fit_design_to_neutral_image
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mask import pin_area
from tactip_twin.tactip_model.neutral_image import neutral_px
from tactip_twin.tactip_model.pin_detection import find_blobs
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

SIZE = 256
DESIGN = design_named("nominal-127")
COLUMNS = ["pose_z=-pose_2-5", "pose_Ry=pose_6", "shear_x=move_1"]


def frame(zoom=1.0, design=DESIGN):
    """A binary frame of the tip, its pins spread by a zoom."""
    tips, directions = neutral_pins(design)
    settings = replace(design.image, size_px=SIZE)
    return tactile_image(Raster(design).render(tips * [zoom, zoom, 1.0], directions), settings)


def with_rim(image):
    """The frame with light at the rim: a long patch, and a speck broken off it."""
    lit = image.copy()
    cv2.ellipse(lit, (SIZE // 2, SIZE // 2), (126, 126), 0, 20, 70, 255, 5)
    cv2.circle(lit, (SIZE // 2 - 124, SIZE // 2 - 10), 3, 255, -1)
    return lit


def write_set(folder, count=12, name="frame_{}.png", **extra):
    (folder / "images").mkdir(parents=True)
    cv2.imwrite(str(folder / "init_0.png"), with_rim(frame()))
    rng = np.random.default_rng(0)
    rows = []
    for k in range(count):
        depth = rng.uniform(-4, 0)
        cv2.imwrite(str(folder / "images" / name.format(k)), with_rim(frame(1 + 0.02 * (5 + depth))))
        row = {"image_name": name.format(k), "pose_1": 0, "pose_2": depth, "pose_6": rng.uniform(-20, 20)}
        rows.append(row | {"move_1": rng.uniform(-5, 5)} | extra)
    write_table(folder, rows)
    return rows


def write_table(folder, rows):
    with (folder / "targets.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def redraw(folder, change):
    """Put what a function makes of each of a laboratory's images in its place."""
    for path in [folder / "init_0.png", *(folder / "images").iterdir()]:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        cv2.imwrite(str(path), change(image))


def bring(folder, out, *options):
    return tactip.main(["import", str(folder), "--out", str(out), "--columns", *COLUMNS, *options])


def test_import_complete_set(tmp_path, capsys):
    rows = write_set(tmp_path / "lab")
    assert bring(tmp_path / "lab", tmp_path / "set", "--tcp-behind-apex-mm", "0") == 0
    output = capsys.readouterr().out
    assert "12 of 12 frames imported; pins: median 127, 127 to 127" in output
    assert "shear_x: " in output
    assert tactip.main(["dataset", "verify", str(tmp_path / "set")]) == 0
    dataset = read_dataset(tmp_path / "set")
    assert np.allclose(dataset.poses[:, 2], [-row["pose_2"] - 5 for row in rows], atol=1e-6)
    assert np.allclose(dataset.poses[:, 4], [row["pose_6"] for row in rows], atol=1e-6)
    samples = read_samples(tmp_path / "set")  # as training and evaluation read it
    assert samples.images.shape == (12, 128, 128)
    assert samples.labels.components == ("z", "Rx", "Ry")
    picture = cv2.imread(str(tmp_path / "set" / "import.png"))
    assert picture is not None and picture.shape[1] > 1000
    # The same command again finds it done; another one does not write over it.
    assert bring(tmp_path / "lab", tmp_path / "set", "--tcp-behind-apex-mm", "0") == 0
    assert "already holds this set" in capsys.readouterr().out
    assert bring(tmp_path / "lab", tmp_path / "set", "--tcp-behind-apex-mm", "5") == 1
    output = capsys.readouterr().err
    assert "holds a real data set with other settings (layout.tcp_behind_apex_mm is 0.0 there, 5.0 here)" in output
    # Nor does any into a folder of something else.
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "notes.txt").touch()
    assert bring(tmp_path / "lab", tmp_path / "notes") == 1
    assert "is not empty and holds no real data set" in capsys.readouterr().err


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
    assert why["frame_4.png"] == "it must be 256×256 px like the others, got 300×256 px"
    assert why["frame_5.png"] == "its row has a value that is not a finite number"
    assert tactip.main(["dataset", "verify", str(tmp_path / "set")]) == 0


@pytest.mark.parametrize(
    ("spoil", "options", "words"),
    [
        (lambda lab: (lab / "targets.csv").unlink(), [], "targets.csv does not exist: name the table with --targets"),
        (
            lambda lab: [(lab / "targets.csv").rename(lab / "a.csv"), (lab / "b.csv").touch()],
            [],
            "has no targets.csv: name the table with --targets",
        ),
        (lambda lab: (lab / "targets.csv").write_text("image_name,pose_2\n"), [], "has no rows"),
        (lambda lab: None, ["--image-column", "photo"], "has no column photo"),
        (lambda lab: [p.unlink() for p in (lab / "images").iterdir()], [], "none of the table's frames exists"),
        (
            lambda lab: [cv2.imwrite(str(p), np.zeros((9, 9))) for p in (lab / "images").iterdir()],
            [],
            "12 of 12 frames cannot be used",
        ),
        (lambda lab: None, ["--neutral", "none.png"], "the neutral image none.png does not exist"),
        (lambda lab: None, ["--crop", "0", "0", "256", "128"], "must be square, got 256×128 px"),
        (lambda lab: None, ["--crop", "0", "0", "0", "0"], "must be square, got 0×0 px"),
        (lambda lab: None, ["--crop", "0", "0", "999", "999"], "must lie within the frame of 256×256 px"),
    ],
)
def test_import_wrong_set_reports_error(tmp_path, capsys, spoil, options, words):
    write_set(tmp_path / "lab")
    spoil(tmp_path / "lab")
    assert bring(tmp_path / "lab", tmp_path / "set", *options) == 1
    output = capsys.readouterr().err.strip().splitlines()[-1]
    assert words in output
    assert not (tmp_path / "set" / "meta.json").exists()


def test_import_unknown_task_lists_choices(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        bring(tmp_path / "lab", tmp_path / "set", "--task", "corner")
    assert ended.value.code == 2
    output = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert "invalid choice 'corner' for argument '--task'. Expected one of ('surface', 'edge')" in output


def test_import_uses_only_table_of_any_name(tmp_path):
    write_set(tmp_path / "lab")
    (tmp_path / "lab" / "targets.csv").rename(tmp_path / "lab" / "targets_images.csv")
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    assert len(read_dataset(tmp_path / "set").images) == 12


def test_import_into_damaged_set_reports_error(tmp_path, capsys):
    write_set(tmp_path / "lab")
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "meta.json").write_text('{"format": ')
    assert bring(tmp_path / "lab", tmp_path / "set") == 1
    assert "meta.json is not JSON" in capsys.readouterr().err


def test_import_names_outside_folder_are_refused(tmp_path, capsys):
    rows = write_set(tmp_path / "lab")
    cv2.imwrite(str(tmp_path / "secret.png"), frame())
    rows[0]["image_name"] = "../secret.png"
    write_table(tmp_path / "lab", rows)
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    report = json.loads((tmp_path / "set" / "import.json").read_text())
    assert report["left_out"][0]["why"] == "the file does not exist"


def test_import_interrupted_starts_again(tmp_path, monkeypatch):
    write_set(tmp_path / "lab")
    real = preprocess.read_file

    def stop(path):
        if path.name == "frame_7.png":
            raise KeyboardInterrupt
        return real(path)

    monkeypatch.setattr(preprocess, "read_file", stop)
    assert bring(tmp_path / "lab", tmp_path / "set") == 130
    monkeypatch.setattr(preprocess, "read_file", real)
    assert not (tmp_path / "set" / "meta.json").exists()
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    assert bring(tmp_path / "lab", tmp_path / "other") == 0
    for name in ("meta.json", "targets.csv", "import.json"):
        assert (tmp_path / "set" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()


def test_import_killed_before_last_file_is_recognized(tmp_path, monkeypatch):
    write_set(tmp_path / "lab")
    real = importing.write_file

    def killed(path, data):
        if path.name == "meta.json":
            raise KeyboardInterrupt
        real(path, data)

    monkeypatch.setattr(importing, "write_file", killed)
    assert bring(tmp_path / "lab", tmp_path / "set") == 130
    assert (tmp_path / "set" / "targets.csv").exists()
    monkeypatch.setattr(importing, "write_file", real)
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    assert tactip.main(["dataset", "verify", str(tmp_path / "set")]) == 0


def test_import_other_or_broken_neutral_image_is_refused(tmp_path, capsys):
    write_set(tmp_path / "lab")
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    other, broken = tmp_path / "other.png", tmp_path / "broken.png"
    cv2.imwrite(str(other), frame(1.01))
    broken.write_bytes(b"no image")
    capsys.readouterr()
    assert bring(tmp_path / "lab", tmp_path / "set", "--neutral", str(other)) == 1
    assert "holds a real data set with other settings (source.neutral_sha256 is" in capsys.readouterr().err
    assert bring(tmp_path / "lab", tmp_path / "third", "--neutral", str(broken)) == 1
    assert "broken.png: it cannot be read as an image" in capsys.readouterr().err


def test_import_without_neutral_image_skips_unusable_frames(tmp_path):
    write_set(tmp_path / "lab")
    (tmp_path / "lab" / "init_0.png").unlink()
    images = tmp_path / "lab" / "images"
    (images / "frame_1.png").write_bytes(b"no image")
    cv2.imwrite(str(images / "frame_3.png"), np.zeros((SIZE, 300), np.uint8))
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    report = json.loads((tmp_path / "set" / "import.json").read_text())
    assert [one["frame"] for one in report["left_out"]] == ["frame_1.png", "frame_3.png"]


def test_import_without_neutral_image_uses_shallowest_frames(tmp_path, capsys):
    """Each presses the pins of another part outward by two of their widths: in most frames they are where they were."""
    write_set(tmp_path / "lab", 1)
    (tmp_path / "lab" / "init_0.png").unlink()
    tips, directions = neutral_pins(DESIGN)
    rows = []
    for k in range(90):
        depth = 0.05 if k < 5 else 4.0
        away = tips[:, :2] - 0.008 * np.array([np.cos(1.2 * k), np.sin(1.2 * k)])
        pressed = np.linalg.norm(away, axis=1) < 2e-3 * (1 + depth)
        moved = tips + np.where(pressed[:, None], np.pad(away * 0.4, ((0, 0), (0, 1))), 0.0)
        image = tactile_image(Raster(DESIGN).render(moved, directions), replace(DESIGN.image, size_px=SIZE))
        cv2.imwrite(str(tmp_path / "lab" / "images" / f"frame_{k}.png"), with_rim(image))
        rows.append({"image_name": f"frame_{k}.png", "pose_2": depth - 5})
    write_table(tmp_path / "lab", rows)
    command = ["import", str(tmp_path / "lab"), "--out", str(tmp_path / "set"), "--columns", "pose_z=-pose_2-5"]
    assert tactip.main(command) == 0
    output = "no neutral image: replaced by the median of 5 of the shallowest frames (-0.05 to -0.05 mm)"
    assert output in capsys.readouterr().out
    design, figures = fit_design_to_neutral_image(tmp_path / "set", 128)
    assert figures["pins"] == 127 and figures["camera"] is None
    assert np.abs(neutral_px(design) - neutral_px(DESIGN)).max() < 0.6
    # One that an earlier version imported, which kept no such image, is imported anew.
    report = json.loads((tmp_path / "set" / "import.json").read_text())
    del report["stand_in"]
    (tmp_path / "set" / "import.json").write_text(json.dumps(report))
    assert tactip.main(command) == 0
    assert "whose report is incomplete" in capsys.readouterr().out
    # And one whose report is damaged is named.
    (tmp_path / "set" / "import.json").write_text("{")
    assert tactip.main(command) == 1
    assert "import.json is not JSON" in capsys.readouterr().err


def test_fit_design_removes_press_of_pseudo_neutral_frames(tmp_path):
    """Six frames of a stiffer tip at rest 1 to 2 mm deep: the twin's pins are where that tip's are when nothing touches."""
    write_set(tmp_path / "lab", 1)
    (tmp_path / "lab" / "init_0.png").unlink()
    stiffer = replace(DESIGN, materials=replace(DESIGN.materials, skin_young_pa=1.3 * DESIGN.materials.skin_young_pa))
    simulator = ContactSimulator(stiffer, "surface", fidelity_named("draft"))
    rows = []
    for k, depth in enumerate(np.linspace(1, 2, 6)):
        contact = simulator.simulate(from_mm_deg([0, 0, -depth, 0, 0, 0]), np.zeros(6))
        drawn = Raster(DESIGN).render(contact.pin_tips, contact.directions)
        image = tactile_image(drawn, replace(DESIGN.image, size_px=SIZE))
        cv2.imwrite(str(tmp_path / "lab" / "images" / f"frame_{k}.png"), image)
        rows.append({"image_name": f"frame_{k}.png", "pose_2": depth - 5})
    write_table(tmp_path / "lab", rows)
    command = ["import", str(tmp_path / "lab"), "--out", str(tmp_path / "set"), "--columns", "pose_z=-pose_2-5"]
    assert tactip.main(command) == 0

    def off_px():
        design, figures = fit_design_to_neutral_image(tmp_path / "set", 128)
        return np.sqrt(((neutral_px(design) - neutral_px(DESIGN)) ** 2).sum(1).mean()), figures["pressed_mm"], design

    off, pressed_mm, design = off_px()
    assert pressed_mm == pytest.approx(0.75 * 1.4) and off < 0.5
    assert design.pins.diameter_m == pytest.approx(DESIGN.pins.diameter_m, rel=0.15)
    # As it is where the frames' depth is not known to be one.
    report = json.loads((tmp_path / "set" / "import.json").read_text())
    report["stand_in"]["pose_z"] = [0.5, 0.5]
    (tmp_path / "set" / "import.json").write_text(json.dumps(report))
    assert off_px()[:2] == (pytest.approx(1.15, abs=0.2), 0.0)


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
    # The last frame, if none is told; here each shows the tip at rest.
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


def test_import_depth_of_wrong_sign_warns(tmp_path, capsys):
    write_set(tmp_path / "lab")
    wrong = ["pose_z=pose_2+5", *COLUMNS[1:]]
    assert tactip.main(["import", str(tmp_path / "lab"), "--out", str(tmp_path / "set"), "--columns", *wrong]) == 0
    assert "pose_z is mostly positive, but must be negative into the object" in capsys.readouterr().out
    assert bring(tmp_path / "lab", tmp_path / "other") == 0
    assert "mostly positive" not in capsys.readouterr().out


def test_import_other_layout_without_neutral_image(tmp_path):
    """128 px frames of a tip with 331 pins, named without an ending; depth positive, three components, no neutral image."""
    design = design_named("nominal-331")
    small = replace(design, image=replace(design.image, size_px=128))
    tips, directions = neutral_pins(design)
    folder = tmp_path / "lab"
    (folder / "frames").mkdir(parents=True)
    rows = []
    for k in range(6):
        image = tactile_image(Raster(small).render(tips * [1 + 0.01 * k, 1 + 0.01 * k, 1], directions), small.image)
        cv2.imwrite(str(folder / "frames" / f"image_{k}.png"), image)
        rows.append({"sensor_image": f"image_{k}", "depth": 1 + 0.5 * k, "roll": k, "pitch": -k})
    write_table(folder, rows)
    layout = tmp_path / "layout.json"
    layout.write_text(json.dumps({"columns": ["pose_z=-depth", "pose_Rx=roll", "pose_Ry=pitch"]}))
    out = tmp_path / "set"
    assert tactip.main(["import", str(folder), "--out", str(out), "--layout", str(layout)]) == 0
    dataset = read_dataset(out)
    assert np.allclose(dataset.poses[:, 2], [-1 - 0.5 * k for k in range(6)], atol=1e-5)
    assert not dataset.shears.any()
    report = json.loads((out / "import.json").read_text())
    assert not report["neutral_image"] and report["stand_in"] == {"frames": 5, "pose_z": [-1.0, -3.0]}


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (["pose_z=a", "pose_z=b"], "each component must be mapped once, got pose_z more than once"),
        (["pose_z=a+1e308"], r"the numbers in 'pose_z=a\+1e308' must be from -1e\+06 to 1e\+06, got 1e\+308"),
        (["pose_z=" + "9" * 50_000], "must be written in at most 200 characters, got 50007"),
    ],
)
def test_impossible_columns_are_refused(columns, message):
    with pytest.raises(TactipError, match=message):
        ColumnMap(columns=tuple(columns))


@pytest.mark.parametrize("name", ["image_00000.png", "targets.csv", "import.png", "meta.json"])
def test_import_killed_at_a_rename_begins_anew(tmp_path, monkeypatch, name):
    write_set(tmp_path / "lab")
    assert bring(tmp_path / "lab", tmp_path / "whole") == 0
    rename = os.replace

    def killed(old, new):
        if os.path.basename(new) == name:
            raise Killed
        rename(old, new)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(os, "replace", killed)
        bring(tmp_path / "lab", tmp_path / "set")
    assert not (tmp_path / "set" / "meta.json").exists()
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    assert contents(tmp_path / "set") == contents(tmp_path / "whole")


def test_import_into_a_folder_in_use_is_refused(tmp_path, capsys):
    write_set(tmp_path / "lab")
    (tmp_path / "set").mkdir()
    with locked(tmp_path / "set" / importing._WORK, "importing"):
        assert bring(tmp_path / "lab", tmp_path / "set") == 1
    assert f"another command is importing a set into {tmp_path / 'set'}" in capsys.readouterr().err
