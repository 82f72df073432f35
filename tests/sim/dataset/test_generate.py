"""Contents of a set: the same bytes from any number of workers, labels in range, images of its pins; and refused options."""

import json

import cv2
import numpy as np
import pytest

from helpers.set_commands import SEED, configuration, contents, kill_unfinished, make, records, run, run_process, table
from tactip_twin.commands import main as tactip
from tactip_twin.sim.dataset import generate as generation
from tactip_twin.sim.dataset.format import read_dataset
from tactip_twin.sim.dataset.generate import Job
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, generator
from tactip_twin.sim.dataset.verify import verify
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pyrender_renderer import PinCamera
from tactip_twin.tactip_model.tactile_image import tactile_image


def test_make_writes_the_files_of_a_set(whole):
    assert {p.name for p in whole.iterdir()} == {"images", "targets.csv", "pins.npz", "meta.json", "run.json"}
    dataset = read_dataset(whole)
    assert len(dataset.images) == 4
    assert dataset.image(3).shape == (128, 128)
    assert set(np.unique(dataset.image(3))) == {0, 255}
    assert list(table(whole)[0])[:13] == [
        "sensor_image", "pose_x", "pose_y", "pose_z", "pose_Rx", "pose_Ry", "pose_Rz",
        "shear_x", "shear_y", "shear_z", "shear_Rx", "shear_Ry", "shear_Rz",
    ]  # fmt: skip
    meta = json.loads((whole / "meta.json").read_text())
    assert meta["configuration"]["seed"] == SEED
    assert meta["versions"]["mujoco"]
    assert json.loads((whole / meta["timings"]).read_text())["workers"] == 1


def test_make_labels_are_the_samples_of_the_generator(whole):
    dataset = read_dataset(whole)
    rng = generator(SEED, "edge", "train", 3)
    assert np.allclose(from_mm_deg(dataset.poses[3]), POSE_RANGES["edge"].sample(rng), atol=1e-7)
    assert np.allclose(from_mm_deg(dataset.shears[3]), SHEAR_RANGES.sample(rng), atol=1e-7)


def test_make_images_can_be_rendered_again_from_the_pins(whole, design):
    """The recorded pins suffice to render the images again."""
    from tactip_twin.tactip_model.raster_renderer import Raster

    dataset, raster = read_dataset(whole), Raster(design)
    with np.load(whole / "pins.npz", allow_pickle=False) as pins:
        again = [
            tactile_image(raster.render(t, d), design.image)
            for t, d in zip(pins["pin_tips"], pins["directions"], strict=True)
        ]
    same = [(a == dataset.image(i)).mean() for i, a in enumerate(again)]
    assert min(same) > 0.9999  # the record is in single precision


def test_make_measures_are_plausible(whole):
    for row in table(whole):
        assert float(row["penetration_mm"]) <= 0.05
        assert 0.1 < float(row["volume_ratio"]) <= 1.01
        assert float(row["speed_mm_s"]) < 20
        assert row["seed"] == f"{SEED}:edge:train:{row['index']}"


def test_make_two_workers_give_the_same_bytes(tmp_path):
    """Of seed 3, the first contact is repeated on a finer mesh."""
    for workers in (1, 2):
        assert run(make(tmp_path / f"{workers}", samples=2, workers=workers, seed=3)).returncode == 0
    assert table(tmp_path / "1")[0]["tries"] == "2"
    assert contents(tmp_path / "1") == contents(tmp_path / "2")


def test_make_symmetric_samples_are_mirrored_and_resumed(whole, tmp_path):
    """Three contacts and their mirror images make five samples; a killed run is resumed to the same bytes."""
    mirrored, killed = tmp_path / "mirrored", tmp_path / "killed"
    result = run(make(mirrored, "--augment-symmetry", samples=5))
    assert result.returncode == 0, result.stderr
    assert "5 of 5 samples, 5 made now" in result.stdout
    assert verify(mirrored) == []
    dataset, rows = read_dataset(mirrored), table(mirrored)
    assert [row["seed"] for row in rows] == [f"{SEED}:edge:train:{k}" for k in (0, 0, 1, 1, 2)]
    assert np.allclose(dataset.poses[1], dataset.poses[0] * [1, -1, 1, -1, 1, -1])
    assert np.allclose(dataset.shears[3], dataset.shears[2] * [1, -1, 1, -1, 1, -1])
    assert np.array_equal(read_dataset(whole).image(2), dataset.image(4))
    kill_unfinished(make(killed, "--augment-symmetry", samples=5), killed, lambda: len(records(killed)) >= 1)
    for samples in (4, 6):
        refused = run(make(killed, "--augment-symmetry", samples=samples))
        assert refused.returncode == 1 and len(refused.stderr.strip().splitlines()) == 1
        assert f"the unfinished set in {killed} has 5 samples: samples must be 5 until the set is finished" in refused.stderr
        assert f"got {samples}" in refused.stderr
    again = run(make(killed, "--augment-symmetry", samples=5, workers=2))
    assert again.returncode == 0
    assert contents(killed) == contents(mirrored)
    fewer = run(make(killed, "--augment-symmetry", samples=4))
    assert fewer.returncode == 1 and "has 5 samples: samples must be at least 5, got 4" in fewer.stderr
    assert contents(killed) == contents(mirrored)


@pytest.mark.slow
def test_make_symmetric_set_grows(tmp_path):
    for name, sizes in {"whole": (5,), "grown": (3, 5)}.items():
        for samples in sizes:
            assert run(make(tmp_path / name, "--augment-symmetry", samples=samples)).returncode == 0
    assert contents(tmp_path / "grown") == contents(tmp_path / "whole")


def test_make_symmetric_with_asymmetric_ranges_is_refused(tmp_path):
    result = run(make(tmp_path / "set", "--augment-symmetry", "--pose.roll-deg", "-5", "10"))
    assert result.returncode == 1
    assert "the pose ranges are not symmetric" in result.stderr


def test_make_pyrender_set_is_verified_and_shown(tmp_path, design):
    folder = tmp_path / "rendered"
    assert run(make(folder, samples=2, renderer="pyrender")).returncode == 0
    assert tactip.main(["dataset", "verify", str(folder)]) == 0
    sheet = tmp_path / "sheet.png"
    assert tactip.main(["dataset", "show", str(folder), "--out", str(sheet)]) == 0
    image = cv2.imread(str(sheet), cv2.IMREAD_GRAYSCALE)
    assert image.shape[0] > 128
    assert 0 < (image == 0).mean() < 1
    with np.load(folder / "pins.npz", allow_pickle=False) as pins:
        rendered = tactile_image(PinCamera(design).render(pins["pin_tips"][0], pins["directions"][0]), design.image)
    assert (rendered == read_dataset(folder).image(0)).mean() > 0.9999


def test_make_all_tasks_and_splits_in_one_run(tmp_path):
    folder = tmp_path / "all"
    assert run(make(folder, "--split", "all", task="all", samples=1)).returncode == 0
    for task in ("surface", "edge"):
        for split in ("train", "val", "test"):
            assert tactip.main(["dataset", "verify", str(folder / task / split)]) == 0


INVALID = {
    "negative count": (["--samples", "-3"], "samples must be from 1 to 10000000, got -3"),
    "unknown design": (["--design", "digit"], "tactip-127, tactip-331"),
    "range upside down": (["--pose.depth-mm", "-1", "-5"], "with low at most high, got (-1.0, -5.0)"),
    "depth out of the object": (
        ["--pose.depth-mm", "1", "3"],
        "pose.depth_mm must be at most 0 (depth is negative into the object), got (1.0, 3.0)",
    ),
    "no workers": (["--workers", "0"], "workers must be auto or at least 1, got 0"),
    "words for workers": (["--workers", "many"], "workers must be auto or at least 1, got many"),
    "negative seed": (["--seed", "-1"], "seed must be non-negative, got -1"),
}


@pytest.mark.parametrize("case", INVALID)
def test_make_invalid_option_gives_one_sentence(tmp_path, capsys, case):
    options, words = INVALID[case]
    assert tactip.main(["dataset", "make", "--out", str(tmp_path / "never"), *options]) == 1
    message = capsys.readouterr().err.strip()
    assert words in message
    assert len(message.splitlines()) == 1
    assert not (tmp_path / "never").exists()


@pytest.mark.parametrize(
    ("option", "value", "choices"),
    [
        ("--task", "corner", ("surface", "edge", "all")),
        ("--split", "dev", ("train", "val", "test", "all")),
        ("--fidelity", "best", ("draft", "standard", "reference")),
        ("--renderer", "blender", ("pyrender", "raster")),
        ("--randomize-mechanics", "wild", ("none", "real")),
    ],
)
def test_dataset_make_unknown_choice_exits_with_2_and_lists_the_choices(tmp_path, capsys, option, value, choices):
    with pytest.raises(SystemExit) as ended:
        tactip.main(["dataset", "make", "--out", str(tmp_path / "never"), option, value])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert option in error and all(repr(choice) in error for choice in (value, *choices))
    assert not (tmp_path / "never").exists()


def test_make_folder_of_another_configuration_is_refused_and_unchanged(copy, capsys):
    before = contents(copy)
    assert tactip.main(make(copy, seed=1)) == 1
    message = capsys.readouterr().err
    assert f"the folder {copy} holds a data set with other settings" in message
    assert f"(configuration.seed is {SEED} there, 1 here): choose another folder" in message
    assert contents(copy) == before


def test_make_folder_of_another_fidelity_names_both(tmp_path, capsys):
    command = ["dataset", "make", "--out", str(tmp_path), "--samples", "1", "--renderer", "raster", "--workers", "1"]
    assert tactip.main([*command, "--fidelity", "fast"]) == 0
    assert tactip.main([*command, "--fidelity", "draft"]) == 1
    assert f"the folder {tmp_path} holds a data set with the fidelity fast, got draft" in capsys.readouterr().err


def test_make_folder_of_something_else_is_refused_and_unchanged(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("years of work")
    assert tactip.main(["dataset", "make", "--out", str(tmp_path)]) == 1
    assert "is not empty and holds no data set: choose another folder" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_make_unwritable_folder_gives_one_sentence(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert tactip.main(["dataset", "make", "--out", str(tmp_path / "file" / "set")]) == 1
    message = capsys.readouterr().err.strip()
    assert "cannot write to the folder" in message
    assert len(message.splitlines()) == 1


def test_make_missing_option_is_refused_by_the_command_line():
    result = run_process(["dataset", "make"])
    assert result.returncode == 2
    assert "--out" in result.stderr


def test_make_unknown_task_in_python_is_refused(design, tmp_path):
    with pytest.raises(TactipError, match="surface, edge"):
        generation.make([Job(configuration(design, task="corner"), tmp_path / "x")], 1)
