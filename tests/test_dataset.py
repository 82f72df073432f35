"""The data set's promises: whole after a kill, the same bytes from any number of workers, damage found, errors clear."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

import tactip
from sim import generation
from sim.contact import TRIES, Bounds, CarefulPlayer, too_steep
from sim.dataset import Configuration, read_dataset
from sim.fidelity import fidelity_named, finer
from sim.generation import Job
from sim.pose import from_mm_deg
from sim.sampling import POSE_RANGES, SHEAR_RANGES, Ranges, generator
from sim.verification import verify
from tactip_model.camera import PinCamera
from tactip_model.errors import TactipError
from tactip_model.image import tactile_image

TACTIP = [str(Path(sys.executable).parent / "tactip"), "dataset"]


def make(out, *options, task="edge", samples=6, workers=2, renderer="raster"):
    return [*TACTIP, "make", "--task", task, "--samples", str(samples), "--out", str(out), "--workers", str(workers)] + [
        "--fidelity", "draft", "--design", "nominal-127", "--renderer", renderer, *options
    ]  # fmt: skip


def run(command):
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


def table(folder):
    """Rows (list of dict of str) of targets.csv."""
    return list(csv.DictReader((Path(folder) / "targets.csv").read_text().splitlines()))


def contents(folder):
    """Bytes of every file of a set but run.json, which is the one that differs."""
    files = (p for p in Path(folder).rglob("*") if p.is_file() and p.name != "run.json")
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A finished set of six samples by one worker."""
    folder = tmp_path_factory.mktemp("sets") / "whole"
    result = run(make(folder, workers=1))
    assert result.returncode == 0, result.stderr
    return folder


@pytest.fixture
def copy(whole, tmp_path):
    return Path(shutil.copytree(whole, tmp_path / "copy"))


def test_files_of_a_set(whole):
    assert {p.name for p in whole.iterdir()} == {"images", "targets.csv", "pins.npz", "meta.json", "run.json"}
    dataset = read_dataset(whole)
    assert len(dataset.images) == 6
    assert dataset.image(5).shape == (128, 128)
    assert set(np.unique(dataset.image(5))) == {0, 255}
    assert list(table(whole)[0])[:13] == [
        "sensor_image", "pose_x", "pose_y", "pose_z", "pose_Rx", "pose_Ry", "pose_Rz",
        "shear_x", "shear_y", "shear_z", "shear_Rx", "shear_Ry", "shear_Rz",
    ]  # fmt: skip
    meta = json.loads((whole / "meta.json").read_text())
    assert meta["configuration"]["seed"] == 0
    assert meta["versions"]["mujoco"]
    assert json.loads((whole / meta["timings"]).read_text())["workers"] == 1


def test_labels_are_the_draws(whole):
    dataset = read_dataset(whole)
    draw = generator(0, "edge", "train", 3)
    assert np.allclose(from_mm_deg(dataset.poses[3]), POSE_RANGES["edge"].draw(draw), atol=1e-7)
    assert np.allclose(from_mm_deg(dataset.shears[3]), SHEAR_RANGES.draw(draw), atol=1e-7)


def test_images_are_a_function_of_the_pins(whole, design):
    """Physics once, optics many: the record draws the image again, to the bit."""
    from tactip_model.raster import Raster

    dataset, raster = read_dataset(whole), Raster(design)
    with np.load(whole / "pins.npz", allow_pickle=False) as pins:
        again = [
            tactile_image(raster.render(t, d), design.image) for t, d in zip(pins["tips"], pins["directions"], strict=True)
        ]
    same = [(a == dataset.image(i)).mean() for i, a in enumerate(again)]
    assert min(same) > 0.9999  # the record is in single precision


def test_records_measure_what_they_should(whole):
    for row in table(whole):
        assert float(row["penetration_mm"]) <= 0.05
        assert 0.1 < float(row["volume_ratio"]) <= 1.01
        assert float(row["speed_mm_s"]) < 20
        assert row["seed"] == f"0:edge:train:{row['index']}"


def test_two_workers_make_the_same_bytes(whole, tmp_path):
    assert run(make(tmp_path / "two", workers=2)).returncode == 0
    assert contents(tmp_path / "two") == contents(whole)


def wait_for(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not come to that"
        time.sleep(0.02)


def samples_found(told):
    """How many samples a command that goes on found, by its "4 of 6 samples are there already" or "6 of 6 samples"."""
    return int(re.search(r"(\d+) of \d+ samples", told)[1])


def records(folder):
    return sorted(Path(folder).glob(".partial/*.npz"))


@pytest.mark.parametrize("workers", [1, 2])
def test_a_killed_run_is_resumed_to_the_same_bytes(whole, tmp_path, workers):
    folder = tmp_path / "killed"
    process = subprocess.Popen(make(folder, workers=workers), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_for(lambda: len(records(folder)) >= 2)
    process.kill()
    process.wait()
    assert not (folder / "meta.json").exists()
    told = run([*TACTIP, "verify", str(folder)])
    assert told.returncode == 1
    assert "unfinished" in told.stderr
    kept = len(records(folder))
    (folder / "images" / ".image_00000.png.1.tmp").write_bytes(b"half a fi")  # what a kill in a write leaves
    # The orphans of the killed run end by themselves, at the latest with the sample in their hands.
    resumed = run(make(folder, workers=2))
    assert resumed.returncode == 0
    assert samples_found(resumed.stdout) in (kept, kept + 1, kept + 2)
    assert contents(folder) == contents(whole)


def test_a_finished_set_grows_to_the_same_bytes(whole, tmp_path):
    folder = tmp_path / "small"
    assert run(make(folder, samples=3)).returncode == 0
    (folder / ".partial").mkdir()  # and a kill came between the last two steps
    (folder / ".partial" / "configuration.json").write_text("{}")
    grown = run(make(folder))
    assert grown.returncode == 0, grown.stderr
    assert "3 of 6 samples are there already" in grown.stdout
    assert contents(folder) == contents(whole)


def test_growth_that_is_killed_halfway_goes_on(whole, tmp_path, monkeypatch):
    folder = tmp_path / "small"
    assert run(make(folder, samples=4)).returncode == 0
    before = contents(folder)

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("sim.record.record_path", killed)
        options = ["--samples", "6", "--fidelity", "draft", "--renderer", "raster", "--design", "nominal-127"]
        assert tactip.main(["dataset", "make", "--task", "edge", "--out", str(folder), *options]) != 0
    assert before.items() <= contents(folder).items()
    assert run(make(folder)).returncode == 0
    assert contents(folder) == contents(whole)


@pytest.mark.parametrize(("damaged", "words"), [("pins.npz", "damaged"), ("targets.csv", "targets.csv")])
def test_a_damaged_set_does_not_grow(copy, capsys, damaged, words):
    (copy / damaged).write_bytes(b"")
    before = contents(copy)
    options = ["--samples", "8", "--fidelity", "draft", "--renderer", "raster", "--design", "nominal-127"]
    assert tactip.main(["dataset", "make", "--task", "edge", "--out", str(copy), *options]) == 1
    assert words in capsys.readouterr().err
    assert {n: b for n, b in contents(copy).items() if ".partial" not in n} == before


def test_samples_by_symmetry(tmp_path):
    """Three contacts make six samples, a mirror each, and the last is cut short; killed, it is resumed to the same bytes."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    result = run(make(whole, "--symmetric", samples=5, workers=1))
    assert result.returncode == 0, result.stderr
    assert "5 of 5 samples, 5 of them now" in result.stdout
    assert verify(whole) == []
    dataset, rows = read_dataset(whole), table(whole)
    assert [row["seed"] for row in rows] == [f"0:edge:train:{k}" for k in (0, 0, 1, 1, 2)]
    assert np.allclose(dataset.poses[1], dataset.poses[0] * [1, -1, 1, -1, 1, -1])
    assert np.allclose(dataset.shears[3], dataset.shears[2] * [1, -1, 1, -1, 1, -1])
    plain = tmp_path / "plain"
    assert run(make(plain, samples=3)).returncode == 0
    assert np.array_equal(read_dataset(plain).image(2), dataset.image(4))
    process = subprocess.Popen(
        make(killed, "--symmetric", samples=5, workers=1), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    wait_for(lambda: len(records(killed)) >= 1)
    process.kill()
    process.wait()
    again = run(make(killed, "--symmetric", samples=5))
    assert again.returncode == 0
    assert contents(killed) == contents(whole)
    grown = tmp_path / "grown"
    for samples in (3, 5):
        assert run(make(grown, "--symmetric", samples=samples)).returncode == 0
    assert contents(grown) == contents(whole)


def test_uneven_ranges_have_no_symmetry(tmp_path):
    result = run(make(tmp_path / "set", "--symmetric", "--pose.roll-deg", "-5", "10"))
    assert result.returncode == 1
    assert "the ranges of the pose are not as wide to one side as to the other" in result.stderr


def test_an_image_lost_before_the_end_is_made_again(whole, tmp_path):
    folder = tmp_path / "holed"
    process = subprocess.Popen(make(folder), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    # Which worker is the first is chance: with three records, image 0 may still be on its way.
    wait_for((folder / ".partial" / "000000.npz").exists)
    process.kill()
    process.wait()
    (folder / "images" / "image_00000.png").unlink()
    assert run(make(folder)).returncode == 0
    assert contents(folder) == contents(whole)


def test_resuming_makes_only_what_is_missing(whole, tmp_path):
    folder = tmp_path / "resumed"
    assert run(make(folder)).returncode == 0
    again = run(make(folder))
    assert again.returncode == 0
    assert "complete already" in again.stdout
    assert contents(folder) == contents(whole)


@pytest.mark.parametrize("after", [0, 3])
def test_ctrl_c_keeps_what_is_done(tmp_path, after):
    """While the workers are starting, and in the middle of the work."""
    folder = tmp_path / "stopped"
    process = subprocess.Popen(
        make(folder, samples=60),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Where the tests run in the background of a shell, Ctrl-C is ignored, and children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )
    wait_for(lambda: (folder / ".partial" / "configuration.json").exists() and len(records(folder)) >= after)
    time.sleep(0.3)  # into the start of the workers
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to parent and workers alike
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "the same command goes on from there" in told
    assert "Traceback" not in told
    assert after <= len(records(folder)) < 60


def test_a_dead_worker_is_replaced(whole, tmp_path):
    folder = tmp_path / "replaced"
    process = subprocess.Popen(make(folder, workers=1), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    wait_for(lambda: len(records(folder)) >= 1)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    workers = [c for c in children if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]
    os.kill(int(workers[0]), signal.SIGKILL)
    told, _ = process.communicate(timeout=120)
    assert process.returncode == 0, told
    assert "another takes over" in told
    assert contents(folder) == contents(whole)


def test_two_commands_do_not_make_one_set(tmp_path):
    folder = tmp_path / "contested"
    first = subprocess.Popen(make(folder, samples=60), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        wait_for(lambda: len(records(folder)) >= 1)
        second = run(make(folder, samples=60))
        assert second.returncode == 1
        assert "another command is making" in second.stderr
    finally:
        first.kill()
        first.wait()


@pytest.mark.parametrize("begun", [".partial", ".partial/lock", ".targets.csv.7.tmp"])
def test_a_kill_in_the_very_first_or_last_writes_is_mended(whole, tmp_path, begun):
    """Folders and lock made and nothing else; half a table beside them."""
    folder = tmp_path / "begun"
    (folder / ".partial").mkdir(parents=True)
    if begun != ".partial":
        (folder / begun).write_text("")
    assert run(make(folder)).returncode == 0
    assert contents(folder) == contents(whole)


def test_a_kill_between_the_last_two_steps_is_mended(copy, whole):
    (copy / ".partial").mkdir()
    (copy / ".partial" / "000000.npz").write_bytes(b"")
    assert run(make(copy)).returncode == 0
    assert contents(copy) == contents(whole)


def configuration(design, **changes):
    values = {
        "task": "surface",
        "split": "train",
        "samples": 3,
        "seed": 0,
        "renderer": "raster",
        "design": design,
        "fidelity": fidelity_named("draft"),
        "pose": POSE_RANGES["surface"],
        "shear": SHEAR_RANGES,
    }
    return Configuration(**{**values, **changes})


def test_a_contact_that_cannot_be_trusted_is_tried_again_then_named(design, tmp_path):
    """No contact keeps a penetration bound of a nanometre: all are tried again, left out, and named with the reason."""
    job = Job(configuration(design, bounds=Bounds(penetration_m=1e-9)), tmp_path / "failed")
    (result,) = generation.make([job], workers=1, say=lambda line: None)
    assert result["kept"] == 0
    meta = json.loads((job.folder / "meta.json").read_text())
    assert [f["index"] for f in meta["failures"]] == [0, 1, 2]
    assert all(len(f["tries"]) == TRIES and "inside the skin" in f["tries"][-1][0] for f in meta["failures"])
    assert list((job.folder / "images").iterdir()) == []
    assert tactip.main(["dataset", "verify", str(job.folder)]) == 0


def test_the_second_try_takes_finer_steps(design):
    """A bound between the penetrations of the two tries: the contact is good, and says that it took two."""
    draft = fidelity_named("draft")
    pose, shear = from_mm_deg([0, 0, -5, 10, 0, 0]), np.zeros(6)
    coarse, fine = (CarefulPlayer(design, "surface", f, Bounds()).play(pose, shear)[0] for f in (draft, finer(draft)))
    between = (coarse.penetration_m + fine.penetration_m) / 2
    contact, faults = CarefulPlayer(design, "surface", draft, Bounds(penetration_m=between)).play(pose, shear)
    assert len(faults) == 1
    assert contact.penetration_m == fine.penetration_m


def test_a_diverged_state_is_a_fault(on_surface):
    from dataclasses import replace

    contact = on_surface([0, 0, -2, 0, 0, 0])
    assert contact.faults(Bounds()) == []
    broken = replace(contact, tips=np.where(contact.tips == contact.tips.max(), np.nan, contact.tips))
    assert "not finite" in broken.faults(Bounds())[0]
    assert "shrank" in replace(contact, volume_ratio=-0.2).faults(Bounds())[0]
    assert "mm/s" in replace(contact, speed_m_s=1.0).faults(Bounds())[0]


def test_a_state_that_blows_up_is_seen(design, monkeypatch):
    """Not a number in one vertex in mid-press: the record must say so, not start again from the undeformed tip."""
    player = CarefulPlayer(design, "surface", fidelity_named("draft"), Bounds())
    scene = player._players[0].scene
    place, steps = scene.place, []

    def poisoned(*where):
        place(*where)
        steps.append(where)
        if len(steps) == 4:
            scene.data.qpos[100] = np.nan

    monkeypatch.setattr(scene, "place", poisoned)
    contact, faults = player.play(from_mm_deg([0, 0, -3, 0, 0, 0]), np.zeros(6))
    assert faults == [["the state is not finite"]]
    assert contact.faults(Bounds()) == []  # the second try is another scene, and good


def test_pyrender_sets_are_made_and_show(tmp_path, design):
    folder = tmp_path / "drawn"
    assert run(make(folder, samples=2, renderer="pyrender")).returncode == 0
    assert tactip.main(["dataset", "verify", str(folder)]) == 0
    sheet = tmp_path / "sheet.png"
    assert tactip.main(["dataset", "show", str(folder), "--out", str(sheet)]) == 0
    image = cv2.imread(str(sheet), cv2.IMREAD_GRAYSCALE)
    assert image.shape[0] > 128
    assert 0 < (image == 0).mean() < 1
    with np.load(folder / "pins.npz", allow_pickle=False) as pins:
        drawn = tactile_image(PinCamera(design).render(pins["tips"][0], pins["directions"][0]), design.image)
    assert (drawn == read_dataset(folder).image(0)).mean() > 0.9999


def test_all_sets_of_a_job_by_one_crew(tmp_path):
    folder = tmp_path / "all"
    assert run(make(folder, "--split", "all", task="all", samples=1)).returncode == 0
    for task in ("surface", "edge"):
        for split in ("train", "val", "test"):
            assert tactip.main(["dataset", "verify", str(folder / task / split)]) == 0


def damage_missing_image(folder):
    (folder / "images" / "image_00002.png").unlink()


def damage_truncated_image(folder):
    path = folder / "images" / "image_00002.png"
    path.write_bytes(path.read_bytes()[:60])


def damage_altered_image(folder):
    path = folder / "images" / "image_00002.png"
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    image[0, 0] = 255
    cv2.imwrite(str(path), image)


def damage_extra_image(folder):
    shutil.copy(folder / "images" / "image_00002.png", folder / "images" / "image_00009.png")


def damage_bad_number(folder):
    edit(folder, 3, "pose_z", "deep")


def damage_infinite_number(folder):
    edit(folder, 3, "pose_z", "inf")


def damage_out_of_range(folder):
    edit(folder, 3, "pose_Rz", "80.0")


def damage_short_row(folder):
    path = folder / "targets.csv"
    lines = path.read_text().splitlines()
    lines[2] = ",".join(lines[2].split(",")[:5])
    path.write_text("\n".join(lines) + "\n")


def damage_foreign_row(folder):
    edit(folder, 3, "seed", "7:edge:train:3")


def damage_missing_pins(folder):
    (folder / "pins.npz").unlink()


def damage_pins_of_another_set(folder):
    with np.load(folder / "pins.npz", allow_pickle=False) as pins:
        arrays = {k: pins[k] for k in pins.files}
    np.savez(folder / "pins.npz", **{**arrays, "digest": np.array("0" * 64)})


def damage_truncated_pins(folder):
    path = folder / "pins.npz"
    path.write_bytes(path.read_bytes()[:500])


def damage_emptied_pins(folder):
    (folder / "pins.npz").write_bytes(b"")


def damage_configuration(folder):
    path = folder / "meta.json"
    meta = json.loads(path.read_text())
    meta["configuration"]["design"]["materials"]["friction"] = 0.9
    path.write_text(json.dumps(meta))


def edit(folder, number, column, value):
    path = folder / "targets.csv"
    rows = table(folder)
    rows[number][column] = value
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


DAMAGES = {
    damage_missing_image: "image_00002.png: missing",
    damage_truncated_image: "image_00002.png: truncated",
    damage_altered_image: "image_00002.png: altered",
    damage_extra_image: "image_00009.png: has no row",
    damage_bad_number: "line 5: pose_z is 'deep', not a number",
    damage_infinite_number: "not a finite number",
    damage_out_of_range: "a row of another configuration",
    damage_short_row: "line 3: it has more or fewer cells",
    damage_foreign_row: "a mixed configuration",
    damage_missing_pins: "pins.npz: missing",
    damage_pins_of_another_set: "pins.npz: it belongs to a set of another configuration",
    damage_truncated_pins: "pins.npz: it cannot be read",
    damage_emptied_pins: "pins.npz: it cannot be read",
    damage_configuration: "its configuration was altered",
}


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda d: d.__name__)
def test_verify_finds(copy, capsys, damage):
    damage(copy)
    assert tactip.main(["dataset", "verify", str(copy)]) == 1
    assert DAMAGES[damage] in capsys.readouterr().err


def test_a_whole_set_is_whole(copy, capsys):
    assert tactip.main(["dataset", "verify", str(copy)]) == 0
    assert "whole; 6 samples" in capsys.readouterr().out


BAD = {
    "negative count": (["--samples", "-3"], "at least 1"),
    "unknown task": (["--task", "corner"], "surface, edge"),
    "unknown split": (["--split", "dev"], "train, val, test"),
    "unknown design": (["--design", "digit"], "tactip-127, tactip-331"),
    "unknown fidelity": (["--fidelity", "best"], "draft, standard, reference"),
    "unknown renderer": (["--renderer", "blender"], "pyrender, raster"),
    "range upside down": (["--pose.depth-mm", "-1", "-5"], "low must not be above its high"),
    "no workers": (["--workers", "0"], "at least 1"),
    "words for workers": (["--workers", "many"], "auto"),
    "negative seed": (["--seed", "-1"], "0 or more"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_options_give_one_sentence(tmp_path, capsys, case):
    options, words = BAD[case]
    assert tactip.main(["dataset", "make", "--out", str(tmp_path / "never"), *options]) == 1
    told = capsys.readouterr().err.strip()
    assert words in told
    assert len(told.splitlines()) == 1
    assert not (tmp_path / "never").exists()


def test_a_folder_of_another_configuration_is_refused_and_left_alone(copy, capsys):
    before = contents(copy)
    options = ["--task", "edge", "--samples", "6", "--fidelity", "draft", "--renderer", "raster"]
    assert tactip.main(["dataset", "make", "--out", str(copy), *options, "--design", "nominal-127", "--seed", "1"]) == 1
    told = capsys.readouterr().err
    assert "another configuration" in told
    assert "seed is 0 there and 1 here" in told
    assert contents(copy) == before


def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("years of work")
    assert tactip.main(["dataset", "make", "--out", str(tmp_path)]) == 1
    assert "not empty" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_an_unwritable_folder_gives_one_sentence(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert tactip.main(["dataset", "make", "--out", str(tmp_path / "file" / "set")]) == 1
    told = capsys.readouterr().err.strip()
    assert "cannot write to the folder" in told
    assert len(told.splitlines()) == 1


def test_a_full_disk_gives_one_sentence_and_keeps_what_is_done(tmp_path, monkeypatch, design):
    """A limit on the size of files stands in for the disk: images fit, records do not."""
    folder = tmp_path / "full"
    limited = ["prlimit", "--fsize=4096", *make(folder, workers=1)]
    result = run(limited)
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    assert "cannot write" in result.stderr
    assert "goes on from there" in result.stderr
    assert run(make(folder)).returncode == 0
    assert tactip.main(["dataset", "verify", str(folder)]) == 0


def test_nothing_to_verify_or_show(tmp_path, capsys):
    for action in ("verify", "show"):
        assert tactip.main(["dataset", action, str(tmp_path)]) == 1
        assert "no data set" in capsys.readouterr().err


def test_a_foreign_meta_is_refused(tmp_path, capsys):
    (tmp_path / "meta.json").write_text('{"num_poses": 5000}')
    assert tactip.main(["dataset", "verify", str(tmp_path)]) == 1
    assert "not describe a data set of this project" in capsys.readouterr().err


def test_missing_options_are_refused_by_the_command_line():
    result = run([*TACTIP, "make"])
    assert result.returncode == 2
    assert "--out" in result.stderr


def test_unknown_configuration_in_python(design, tmp_path):
    with pytest.raises(TactipError, match="surface, edge"):
        generation.make([Job(configuration(design, task="corner"), tmp_path / "x")], 1)


def test_what_is_too_steep_is_drawn_again(design):
    """±20 degrees two ways and what the shear adds to them leave the cone of 30 degrees in the corners alone: what is
    inside is as it was drawn, so that a set of gentler ranges is the same as ever."""
    wide = Ranges(depth_mm=(-5, -1), roll_deg=(-20, 20), pitch_deg=(-20, 20))
    c = configuration(design, pose=wide)
    again = 0
    for number in range(400):
        draw, given = generator(0, "surface", "train", number), generation.drawn(c, number)
        assert not too_steep(given.pose, given.shear)
        pose, shear = wide.draw(draw), SHEAR_RANGES.draw(draw)
        again += too_steep(pose, shear)
        assert too_steep(pose, shear) or ((given.pose == pose).all() and (given.shear == shear).all())
    assert 0 < again < 20
    gentle = configuration(design)
    assert not any(too_steep(d.pose, d.shear) for d in (generation.drawn(gentle, number) for number in range(50)))


def test_ranges_that_are_too_steep_throughout_are_refused(design, tmp_path):
    c = configuration(design, pose=Ranges(depth_mm=(-3, -1), roll_deg=(25, 28), pitch_deg=(25, 28)))
    with pytest.raises(TactipError, match="all are steeper than 30 degrees"):
        generation.make([Job(c, tmp_path / "steep")], workers=1, say=lambda line: None)
    assert not (tmp_path / "steep").exists()
