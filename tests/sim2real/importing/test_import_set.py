"""Import of a laboratory's set: what is written, what is refused, and interruptions."""

import csv
import json
import os
import shutil

import cv2
import numpy as np
import pytest

from helpers.kills import Killed, contents
from helpers.laboratory import COLUMNS, SIZE, bring, frame, redraw, write_set, write_table
from tactip_twin.commands import main as tactip
from tactip_twin.learning.data import read_samples
from tactip_twin.sim.dataset.format import image_name, read_dataset
from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.sim2real.importing import import_set as importing
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.source import MAX_FRAMES, read_source
from tactip_twin.sim2real.sensor import preprocess
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import MAX_JSON_BYTES


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


def test_import_reads_tables_of_spreadsheets_and_other_machines(tmp_path):
    """Semicolons, decimal commas, blanks, and absolute paths of where the frames once were: the same labels and images."""
    rows = write_set(tmp_path / "lab")
    assert bring(tmp_path / "lab", tmp_path / "one") == 0
    places = ("C:\\lab\\images\\", f"{tmp_path.resolve()}/lab/images/", "/home/lab/images/")
    lines = [";".join(rows[0])]
    for k, row in enumerate(rows):
        cells = [f"{places[k % 3]}{row['image_name']}", *(f" {value}".replace(".", ",") for value in list(row.values())[1:])]
        lines.append(";".join(cells))
    (tmp_path / "lab" / "targets.csv").write_text("\n".join(lines))
    assert bring(tmp_path / "lab", tmp_path / "other") == 0
    one, other = (read_dataset(tmp_path / name) for name in ("one", "other"))
    assert np.array_equal(one.poses, other.poses)
    assert all(np.array_equal(one.images[k], other.images[k]) for k in range(len(rows)))


def test_import_doubts_units_and_repeated_frames(tmp_path, capsys):
    rows = write_set(tmp_path / "lab")
    for row in rows:
        row.update(pose_2=1e-3 * row["pose_2"], pose_6=np.radians(row["pose_6"]))
    write_table(tmp_path / "lab", [*rows, rows[0]])
    assert bring(tmp_path / "lab", tmp_path / "set", "--columns", "pose_z=-pose_2-0.005", "pose_Ry=pose_6") == 0
    output = capsys.readouterr().out
    assert "if the table is in metres, scale it (--columns pose_z=1000*COLUMN)" in output
    assert "if the table is in radians, scale them" in output
    assert "1 rows name the frame of another row" in output


def test_import_into_damaged_set_reports_error(tmp_path, capsys):
    write_set(tmp_path / "lab")
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "meta.json").write_text('{"format": ')
    assert bring(tmp_path / "lab", tmp_path / "set") == 1
    assert "meta.json is not JSON" in capsys.readouterr().err


def test_import_more_frames_than_its_meta_json_can_hold_is_refused(tmp_path, monkeypatch, capsys):
    write_set(tmp_path / "lab")
    monkeypatch.setattr("tactip_twin.sim2real.importing.source.MAX_FRAMES", 11)
    assert bring(tmp_path / "lab", tmp_path / "set") == 1
    assert "targets.csv must be at most 11 (divide a larger set), got 12" in capsys.readouterr().err
    assert MAX_FRAMES * len(f'  "images/{image_name(MAX_FRAMES)}": "{64 * "f"}",\n') < MAX_JSON_BYTES


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


def test_import_depth_of_wrong_sign_warns(tmp_path, capsys):
    write_set(tmp_path / "lab")
    wrong = ["pose_z=pose_2+5", *COLUMNS[1:]]
    assert tactip.main(["import", str(tmp_path / "lab"), "--out", str(tmp_path / "set"), "--columns", *wrong]) == 0
    assert "pose_z is mostly positive, but must be negative into the object" in capsys.readouterr().out
    assert bring(tmp_path / "lab", tmp_path / "other") == 0
    assert "mostly positive" not in capsys.readouterr().out


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


def test_import_takes_the_frame_whose_path_ends_as_the_table_has_it(tmp_path, capsys):
    """Two runs with frames of the same names: each row gets its own, wherever the set was recorded."""
    rows = write_set(tmp_path / "lab")
    (tmp_path / "lab" / "images").rename(tmp_path / "lab" / "run1")
    (tmp_path / "lab" / "run2").mkdir()
    for row in rows:
        place = tmp_path / "lab" / "run2" / row["image_name"]
        cv2.imwrite(str(place), frame(1.15))
    named = [row | {"image_name": f"{place}{row['image_name']}"} for place in ("/data/run1/", "run2/") for row in rows]
    write_table(tmp_path / "lab", named)
    source = read_source(tmp_path / "lab", ColumnMap(columns=tuple(COLUMNS)))
    assert [path.parent.name for path in source.paths] == ["run1"] * 12 + ["run2"] * 12
    # Without the second run, its rows would get the first one's frames.
    write_table(tmp_path / "lab", [row | {"image_name": f"run{1 + k % 2}/frame_{k // 2}.png"} for k, row in enumerate(rows)])
    (tmp_path / "lab" / "run1").rename(tmp_path / "lab" / "images")
    shutil.rmtree(tmp_path / "lab" / "run2")
    assert bring(tmp_path / "lab", tmp_path / "set") == 1
    assert "'run1/frame_0.png' and 'run2/frame_0.png' are different names, but only" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        (["pose_z=1000*pose_2", "pose_Ry=pose_6"], "pose_z must be between -15 and 15 mm, got -"),
        (["pose_z=-pose_2-5", "pose_Ry=pose_6+180"], "pose_Ry must be between -80 and 80 °, got "),
        (["pose_z=-pose_2-5", "shear_x=move_1+300"], "shear_x must be between -50 and 50 mm, got "),
    ],
)
def test_import_impossible_labels_are_refused(tmp_path, capsys, columns, words):
    write_set(tmp_path / "lab")
    assert bring(tmp_path / "lab", tmp_path / "set", "--columns", *columns) == 1
    output = capsys.readouterr().err
    assert "12 of 12 frames cannot be used" in output
    assert words in output


def test_import_compares_the_pins_with_the_neutral_image(tmp_path, capsys):
    write_set(tmp_path / "lab")
    assert bring(tmp_path / "lab", tmp_path / "set", "--crop", "0", "0", "140", "140") == 1
    assert "the crop must keep all pins, got " in capsys.readouterr().err
    cover = np.zeros((SIZE, SIZE), np.uint8)
    cv2.circle(cover, (SIZE // 2, SIZE // 2), 60, 255, -1)
    redraw(tmp_path / "lab", lambda image: np.minimum(image, cover))
    cv2.imwrite(str(tmp_path / "lab" / "init_0.png"), frame())
    assert bring(tmp_path / "lab", tmp_path / "set") == 1
    assert "must show about as many pins as the neutral image, got " in capsys.readouterr().err


def test_import_names_what_it_does_not_use(tmp_path, capsys):
    write_set(tmp_path / "lab", pose_5=0.0)
    rows = [row | {"force": k} for k, row in enumerate(rows_of(tmp_path / "lab"))]
    write_table(tmp_path / "lab", rows[:10])
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    output = capsys.readouterr().out
    assert "columns that vary, but are not used: force\n" in output
    assert "2 images beside the frames are not named in the table, so they are not used" in output


def test_import_again_after_a_missing_frame_came_is_not_taken_for_the_same(tmp_path, capsys):
    write_set(tmp_path / "lab")
    gone = tmp_path / "lab" / "images" / "frame_3.png"
    gone.rename(tmp_path / "frame_3.png")
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    assert "already holds this set" in capsys.readouterr().out
    (tmp_path / "frame_3.png").rename(gone)
    assert bring(tmp_path / "lab", tmp_path / "set") == 1
    assert "source.frames_missing is 1 there, null here" in capsys.readouterr().err


def test_import_reads_published_layouts(tmp_path):
    """Frames in sensor_images/ as JPEG, named without an ending; tables of images and videos beside macOS's own files."""
    write_set(tmp_path / "lab")
    (tmp_path / "lab" / "images").rename(tmp_path / "lab" / "sensor_images")
    for path in (tmp_path / "lab" / "sensor_images").iterdir():
        cv2.imwrite(str(path.with_suffix(".JPG")), cv2.imread(str(path)), [cv2.IMWRITE_JPEG_QUALITY, 100])
        path.unlink()
    rows = [row | {"image_name": row["image_name"].removesuffix(".png")} for row in rows_of(tmp_path / "lab")]
    write_table(tmp_path / "lab", rows)
    (tmp_path / "lab" / "targets.csv").rename(tmp_path / "lab" / "targets_images.csv")
    for name in ("targets_video.csv", "._targets_images.csv"):
        (tmp_path / "lab" / name).write_bytes(b"\xff")
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    assert len(read_dataset(tmp_path / "set").images) == 12


def rows_of(lab):
    """Return the rows of a set's table."""
    with (lab / "targets.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_dark_frames_and_dark_pins_are_told_apart(tmp_path, capsys):
    write_set(tmp_path / "lab")
    neutral = tmp_path / "lab" / "init_0.png"
    image = cv2.imread(str(neutral), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(neutral), 255 - frame())
    assert bring(tmp_path / "lab", tmp_path / "set") == 1
    assert "give --dark-pins" in capsys.readouterr().err
    cv2.imwrite(str(neutral), image // 255)
    assert bring(tmp_path / "lab", tmp_path / "set") == 1
    assert "its pixels have values up to 1 only, of 255" in capsys.readouterr().err
