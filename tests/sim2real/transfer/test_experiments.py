"""Transfer to a sensor that only the network takes for real: a second simulated tip with other rubber, lens and light."""

import csv
import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tactip_twin.benchmarks.learning import transfer as transferred
from tactip_twin.benchmarks.learning.options import TransferOptions
from tactip_twin.commands import main as tactip
from tactip_twin.learning.configuration import RECIPES, PoseNetConfig, Recipe, TrainSettings
from tactip_twin.learning.data import read_samples
from tactip_twin.learning.model import Estimates, load_model, net_sha256
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.format import read_rows
from tactip_twin.sim.fast_tip.fast_tip import any_materials, read_fast_tip
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim2real.importing.frame_blobs import BLOBS, read_blobs
from tactip_twin.sim2real.transfer import real_sensor
from tactip_twin.sim2real.transfer.estimated_mechanics import EstimatedMechanics
from tactip_twin.sim2real.transfer.experiments import ABLATIONS, Experiment, _possible, split_of
from tactip_twin.sim2real.transfer.neutral_calibration import fit_design_to_neutral_image
from tactip_twin.sim2real.transfer.pseudo_real import hidden_design
from tactip_twin.sim2real.transfer.real_shear import real_shear
from tactip_twin.sim2real.transfer.score import score
from tactip_twin.sim2real.transfer.settings import TransferSettings
from tactip_twin.sim2real.transfer.sim_gap import sim_to_real_gap
from tactip_twin.tactip_model.design_file import write_design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import neutral_px
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

SIZE = 256
TINY = Recipe(
    PoseNetConfig(conv_layers=2, filters=8, dense_units=32, batch_size=16, downsample=2),
    TrainSettings(epochs=3, learning_rate=3e-3, augmented_fraction=0.5),
)


def hidden(design):
    """A sensor without a known design: another camera position, thicker pins, other rubber."""
    return replace(
        design,
        materials=replace(design.materials, friction=0.4, gel_young_pa=1.5e4),
        pins=replace(design.pins, rotation_deg=24.0, diameter_m=1.0e-3, rim_diameter_m=0.9e-3),
        optics=replace(design.optics, centre=(0.49, 0.51), neutral_radius=(11.6, 0.04, 0.0026)),
    )


def photo(design, tips, directions):
    """Return a frame with pins and light at the rim."""
    image = tactile_image(Raster(design).render(tips, directions), replace(design.image, size_px=SIZE))
    cv2.ellipse(image, (SIZE // 2, SIZE // 2), (126, 126), 0, 100, 150, 255, 4)
    return image


COLUMNS = ["pose_z=-pose_2-5", "pose_Ry=pose_6", "shear_x=move_1"]


@pytest.fixture(scope="session")
def lab(tmp_path_factory):
    """A folder as a laboratory publishes it: depth before a tap, one tilt, and unlabelled shears."""
    folder = tmp_path_factory.mktemp("lab") / "other_tip"
    (folder / "images").mkdir(parents=True)
    design = hidden(design_named("nominal-127"))
    cv2.imwrite(str(folder / "init_0.png"), photo(design, *neutral_pins(design)))
    simulator, draw, rows = ContactSimulator(design, "surface", fidelity_named("draft")), np.random.default_rng(0), []
    for k in range(60):
        depth, tilt, slid = draw.uniform(-4, 0), draw.uniform(-15, 15), draw.uniform(-3, 3)
        contact = simulator.simulate(from_mm_deg([0, 0, -depth - 5, 0, tilt, 0]), from_mm_deg([slid, 0, 0, 0, 0, 0]))
        cv2.imwrite(str(folder / "images" / f"frame_{k}.png"), photo(design, contact.pin_tips, contact.directions))
        rows.append({"image_name": f"frame_{k}.png", "pose_2": depth, "pose_6": tilt, "move_1": slid})
    with (folder / "targets.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    out = folder.with_name("set")
    assert tactip.main(["import", str(folder), "--out", str(out), "--columns", *COLUMNS]) == 0
    return out


@pytest.fixture(scope="session")
def designed(lab, tmp_path_factory):
    """A folder of results with only the sensor's design, which takes long to estimate."""
    out = tmp_path_factory.mktemp("designed")
    Experiment(lab, out, TransferSettings(real_train_frames=30), 1).design()
    return out


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setitem(RECIPES, "laptop", {"surface": TINY, "edge": TINY})


def test_fit_design_recovers_hidden_pins(lab):
    design, figures = fit_design_to_neutral_image(lab, 128)
    true = hidden(design_named("nominal-127"))
    assert figures["pins"] == 127 and figures["layout"] == "nominal-127"
    assert design.pins.rotation_deg == pytest.approx(24.0, abs=0.5)
    assert np.abs(neutral_px(design) - neutral_px(true)).max() < 0.6  # a tenth of a spacing, by blobs of whole pixels
    # Its images have as many white pixels as the sensor's, although another pipeline made those.
    seen = cv2.imread(str(lab / "neutral_tactile.png"), 0) > 127
    drawn = tactile_image(Raster(design).render(*neutral_pins(design)), design.image) > 127
    assert drawn.sum() == pytest.approx(seen.sum(), rel=0.03)
    assert design.pins.diameter_m == pytest.approx(1.0e-3, rel=0.2)


FEW = ["--contacts", "10", "--val-contacts", "10", "--real-train-frames", "30", "--recipe", "laptop", "--fidelity", "draft"]
FEW += ["--steps", "6", "--workers", "1"]


def test_zero_and_few_shot_from_the_command_line(lab, designed, tiny, tmp_path, capsys):
    shutil.copytree(designed, tmp_path / "out")
    command = ["--real", str(lab), "--out", str(tmp_path / "out"), *FEW, "--shots", "10", "30", "--drawn-contacts", "5"]
    assert tactip.main(["transfer", "zero-shot", *command, "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert set(output) == {"simulation", "real"}
    assert output["simulation"]["samples"] == 30
    assert output["simulation"]["varies"] == {"pose_z": True, "pose_Rx": False, "pose_Ry": True}
    assert all(np.isfinite(v) for part in output.values() for v in part["mae"].values())
    assert tactip.main(["transfer", "few-shot", *command]) == 0
    assert "no contacts are drawn anew (--drawn-contacts): no learned tip predicted those in" in capsys.readouterr().out
    record = json.loads((tmp_path / "out" / "results.json").read_text())
    assert list(record["few-shot"]) == ["10", "30"]
    assert list(record["few-shot"]["10"]) == ["corrected"]
    assert list(record["few-shot"]["30"]) == ["corrected", "alone"]
    assert record["few-shot"]["30"]["alone"] == record["zero-shot"]["real"]
    first, corrected = (load_model(tmp_path / "out" / name) for name in ("network-sim", "network-sim-corrected-by-10"))
    assert corrected.provenance["initial_weights"] == net_sha256(first.net)
    page = (tmp_path / "out" / "results.md").read_text()
    assert "| trained in simulation |" in page and "pose_Rx" not in page
    assert "corrected linearly by 10 real frames" in page and "68 %" not in page  # no intervals
    # Existing results are not made again.
    made = {p: p.stat().st_mtime_ns for p in (tmp_path / "out").rglob("*") if p.name in ("model.pt", "pins.npz")}
    assert tactip.main(["transfer", "few-shot", *command]) == 0
    assert made == {p: p.stat().st_mtime_ns for p in made}


def test_training_starts_from_the_shipped_network_for_as_many_pins(lab, tmp_path):
    """It then takes half as many steps. A set of other pins, or of other images, starts from random weights."""

    def steps(real, **settings):
        few = TransferSettings(real_train_frames=30, **settings)
        return Experiment(real, tmp_path / "out", few, 1).recipe().settings.min_steps

    started, random = steps(lab), steps(lab, init_from="none")
    assert started == random / 2
    assert steps(lab, steps=70) == 70
    assert steps(lab, init_from="edge-tactip-127") == started  # refused when its training begins
    other = tmp_path / "other"
    shutil.copytree(lab, other)
    report = json.loads((other / "import.json").read_text())
    for pins, expected in ((127.0, started), (331.0, random), (200.0, random)):
        report["pins"]["median"] = pins
        (other / "import.json").write_text(json.dumps(report))
        assert steps(other) == expected
    assert steps(lab, recipe="paper") == RECIPES["paper"]["surface"].settings.min_steps


def test_training_on_wide_frames_starts_from_the_shipped_network_for_them_and_takes_as_long(lab, tmp_path):
    wide = tmp_path / "wide"
    frames = str(lab.with_name("other_tip"))
    assert tactip.main(["import", frames, "--out", str(wide), "--size-px", "256", "--columns", *COLUMNS]) == 0
    few = TransferSettings(real_train_frames=30)
    usual, experiment = (Experiment(real, tmp_path / "out", few, 1) for real in (lab, wide))
    assert experiment.recipe().settings.min_steps == usual.recipe().settings.min_steps  # half of those from random weights
    assert (usual.recipe().network.downsample, experiment.recipe().network.downsample) == (2, 4)


def test_design_of_an_earlier_command_is_used_again_if_frames_and_settings_are_the_same(
    lab, designed, tmp_path, monkeypatch
):
    estimates, said = [], []

    def estimate(design, blobs, *_):
        estimates.append(len(blobs))
        return EstimatedMechanics(design, design, {"before_px": 0.5, "after_px": 0.5})

    monkeypatch.setattr(real_sensor, "estimated_mechanics", estimate)

    def found(**settings):
        few = TransferSettings(**({"real_train_frames": 30, "randomize_mechanics": "real"} | settings))
        return Experiment(lab, tmp_path / "out", few, 1, log=said.append).design()

    first = found()
    assert found() == first and len(estimates) == 1
    path = tmp_path / "out" / "design.json"
    assert said[-1] == f"pitch and materials are those in {path}, which were estimated from the same frames"
    for changed in ({"seed": 1}, {"real_train_frames": 40}, {}):
        found(**changed)
    assert estimates == [30, 30, 40, 30]
    # A damaged file is replaced.
    right = path.read_bytes()
    path.write_bytes(right[:500])
    assert found() == first and len(estimates) == 5 and path.read_bytes() == right
    assert any(words.startswith(f"pitch and materials are estimated again: the design file {path} ") for words in said)
    # Whether the materials were estimated is read, too.
    shutil.copy(designed / "design.json", path)
    kept = Experiment(lab, tmp_path / "out", TransferSettings(real_train_frames=30), 1, log=said.append)
    fresh = json.loads(path.read_text())["provenance"]["estimated_materials"]
    assert kept._sensor.mechanics() == ("estimated" if fresh else "real") and len(estimates) == 5


def test_mechanics_are_estimated_from_frames_at_full_size_if_the_import_kept_them(lab, tmp_path, monkeypatch):
    given = []

    def estimate(design, blobs, *_):
        given.append(blobs)
        return EstimatedMechanics(design, design, {"before_px": 0.5, "after_px": 0.5})

    monkeypatch.setattr(real_sensor, "estimated_mechanics", estimate)
    few = TransferSettings(real_train_frames=40, randomize_mechanics="real")
    without = tmp_path / "without"
    shutil.copytree(lab, without)
    (without / BLOBS).unlink()
    meta = json.loads((without / "meta.json").read_text())
    del meta["files"][BLOBS]
    (without / "meta.json").write_text(json.dumps(meta))
    for k, real in enumerate((lab, without)):
        Experiment(real, tmp_path / f"{k}", few, 1).design()
    assert [len(blobs) for blobs in given] == [40, 40]
    kept = read_blobs(lab, json.loads((lab / "meta.json").read_text()))
    assert all(any(np.array_equal(one, centres) for centres in kept.values()) for one in given[0])
    assert not any(np.array_equal(one, centres) for one in given[1] for centres in kept.values())


def test_training_contacts_are_predicted_and_drawn_by_the_learned_tip(lab, designed, tiny, tmp_path):
    shutil.copytree(designed, tmp_path / "out")
    few = TransferSettings(contacts=10, val_contacts=10, drawn_contacts=20, steps=2, init_from="none", real_train_frames=30)
    experiment, tip = Experiment(lab, tmp_path / "out", few, 1), read_fast_tip(any_materials("surface"))
    assert experiment.network().provenance["fast_tip"] == tip.digest
    assert experiment.network().provenance["settings"]["drawn_contacts"] == 20
    for samples in experiment.simulated():
        folder, meta = samples.folder, samples.dataset.meta
        assert meta["configuration"]["fast_tip"] == tip.digest
        assert meta["configuration"]["mechanics_randomization"]["friction"] > 1
        assert "0" in {row["steps"] for row in read_rows(folder, meta)}


def test_frames_steeper_than_simulated_contacts_are_left_out(lab):
    samples, said = read_samples(lab), []
    poses = samples.dataset.poses.copy()
    poses[:5, 4] = 34.0
    found = _possible(replace(samples, dataset=replace(samples.dataset, poses=poses)), said.append)
    assert found.rows.tolist() == list(range(5, len(samples)))
    assert said == [f"5 of {len(samples)} frames are left out: no simulated contact is tilted by more than 30 degrees"]
    assert _possible(samples, said.append) is samples
    poses[:, 4] = 34.0
    with pytest.raises(TactipError, match=f"tilted by at most 30 degrees, .* got none of {len(samples)}"):
        _possible(replace(samples, dataset=replace(samples.dataset, poses=poses)), said.append)


def test_experiment_optics_follow_camera_measurement(lab, tmp_path):
    report = json.loads((lab / "import.json").read_text())
    assert report["camera"] is None  # one arc of light is too little
    known = tmp_path / "known"
    shutil.copytree(lab, known)
    report["camera"] = {"zoom": 1.01, "drift": [0.001, 0.0], "of_one_frame": {"zoom": 1e-3, "drift": [1e-3, 1e-3]}}
    (known / "import.json").write_text(json.dumps(report))
    settings = TransferSettings(real_train_frames=30)
    variants = [ABLATIONS[what] for what in ("complete simulation", "without calibration", "without image noise")]

    def names(folder, **changed):
        experiment = Experiment(folder, tmp_path / "out", replace(settings, **changed))
        return [experiment.optics(variant) for variant in variants]

    assert names(lab) == ["real", "real", "real-clean"]
    assert names(known) == ["steady", "real", "steady-clean"]
    assert names(known, optics_ranges="rim") == ["rim", "rim", "rim-clean"]
    (known / "import.json").unlink()  # as of a simulated set given instead of a real one
    assert names(known, design="tactip-127") == ["real", "real", "real-clean"]
    (known / "import.json").write_text(json.dumps(report))
    own = fit_design_to_neutral_image(lab, 128)[0]
    write_design(tmp_path / "own.json", own, {})
    given = Experiment(known, tmp_path / "out", replace(settings, design=str(tmp_path / "own.json"))).design()
    assert given.optics.zoom == 1.01 and given.pins == own.pins
    with pytest.raises(
        TactipError, match=r"the pins of the design 'tactip-127' must be within 2 px of 256 .* got \d\.\d px"
    ):
        Experiment(known, tmp_path / "out", replace(settings, design="tactip-127")).design()


@pytest.mark.slow
def test_ablate_leaves_out_one_part_each(lab, tiny, tmp_path):
    command = ["--real", str(lab), "--out", str(tmp_path / "out"), *FEW]
    assert tactip.main(["transfer", "zero-shot", *command]) == 0
    assert tactip.main(["transfer", "ablate", *command]) == 0
    record = json.loads((tmp_path / "out" / "results.json").read_text())
    assert list(record["ablate"]) == list(ABLATIONS)
    assert record["ablate"]["complete simulation"] == record["zero-shot"]["simulation"]
    others = [tuple(part["mae"].values()) for part in record["ablate"].values()]
    assert len(set(others)) == len(ABLATIONS)  # each is another network
    flat = read_samples(tmp_path / "out" / "unsheared" / "train")
    assert not flat.shears.any() and read_samples(tmp_path / "out" / "sim" / "train").shears.any()


def test_split_train_and_test_are_disjoint(lab):
    settings = TransferSettings(real_train_frames=30)
    experiment = Experiment(lab, "unused", settings, workers=1)
    known, test = set(experiment.split.known.rows), set(experiment.split.test.rows)
    assert not known & test and len(known | test) == 60
    again = Experiment(lab, "unused", settings, workers=1)
    assert np.array_equal(again.split.known.rows, experiment.split.known.rows)
    ranges = experiment._poses()
    assert ranges.roll_deg == ranges.pitch_deg  # no tilt is narrower than the widest
    assert ranges.depth_mm[1] <= 0


class Constant:
    """A model with a constant error, and a small random one in the depth."""

    def __init__(self, samples):
        draw = np.random.default_rng(0)
        self.off = np.array([0.4, 0.0, 3.0])
        self.noise = np.stack([draw.normal(0, 0.1, len(samples)), np.zeros(len(samples)), np.zeros(len(samples))], 1)
        self.targets = samples.targets

    def estimate(self, images):
        deviations = np.broadcast_to([0.5, 1.0, 2.0], self.targets.shape)
        return Estimates(self.targets + self.off + self.noise, deviations, None)


def test_score_removes_offset_of_depth_only(lab):
    samples = read_samples(lab)
    figures = score(Constant(samples), samples)
    assert figures["mae"]["pose_z"] == pytest.approx(0.4, abs=0.05)
    assert figures["mae_zeroed"]["pose_z"] == pytest.approx(0.1 * np.sqrt(2 / np.pi), rel=0.3)
    assert figures["mae_zeroed"]["pose_Ry"] == figures["mae"]["pose_Ry"] == pytest.approx(3.0)
    # Errors of 0.8, 0 and 1.5 standard deviations.
    assert figures["coverage_68"] == {"pose_z": pytest.approx(0.83, abs=0.15), "pose_Rx": 1.0, "pose_Ry": 0.0}
    assert figures["coverage_95"] == {"pose_z": 1.0, "pose_Rx": 1.0, "pose_Ry": 1.0}


class KnowsShear:
    """A model that reads four fifths of the commanded shear, and otherwise nothing."""

    columns = ("pose_z", "effective_shear_x_mm", "effective_shear_y_mm")

    def __init__(self, samples, quantities=True):
        self.config = PoseNetConfig(quantities=quantities)
        self.shears = {image.tobytes(): shear for image, shear in zip(samples.images, samples.shears, strict=True)}

    def estimate(self, images):
        shears = np.array([self.shears[image.tobytes()] for image in images])
        return Estimates(np.column_stack([np.zeros(len(images)), 0.8 * shears[:, :2]]), None, None)


def test_shear_is_compared_with_what_the_frames_show(lab):
    """These frames do not lag, so they show nearly all of their moves."""
    samples, design = read_samples(lab), hidden(design_named("nominal-127"))
    figures = real_shear(KnowsShear(samples), samples, design)
    assert 20 <= figures["frames"] < len(samples) and figures["shown_fraction"] > 0.8
    assert set(figures) == {"frames", "shown_fraction", "shear_x"}
    assert figures["shear_x"]["slope"] == pytest.approx(0.8, abs=0.15)
    assert figures["shear_x"]["correlation"] > 0.9 and 0.05 < figures["shear_x"]["mae_mm"] < 0.4
    assert real_shear(KnowsShear(samples, quantities=False), samples, design) is None
    unsheared = replace(samples, shears=np.zeros_like(samples.shears))
    assert real_shear(KnowsShear(samples), unsheared, design) is None


@pytest.mark.slow
def test_gap_is_small_with_right_design(lab, tmp_path, capsys):
    """The hidden sensor's own design explains its frames; a design fitted to the neutral image alone nearly does."""
    command = ["transfer", "gap", "--real", str(lab), "--out", str(tmp_path / "out"), "--real-train-frames", "20"]
    assert tactip.main([*command, "--gap-frames", "20", "--fidelity", "draft", "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    left_out = [output[f"{how}_frames"] for how in ("unmatched", "mismatched")]
    assert output["frames"] + sum(left_out) == 20 and output["frames"] > 15
    assert output["best_fraction"]["median"] < 0.4 * output["pins_move"]
    assert (tmp_path / "out" / "gap.png").stat().st_size > 10_000
    assert {"pose_z", "pose_Ry", "shear_mm"} <= set(output["against"])
    # The same with a given design, into a new folder.
    write_design(tmp_path / "own.json", hidden(design_named("nominal-127")), {})
    output = [*command[:-3], str(tmp_path / "other"), *command[-2:], "--design", str(tmp_path / "own.json")]
    output += ["--gap-frames", "8"]
    assert tactip.main([*output, "--fidelity", "draft"]) == 0
    assert (tmp_path / "other" / "gap.png").exists()
    right, _ = sim_to_real_gap(read_samples(lab), hidden(design_named("nominal-127")), "draft", 20)
    assert right["best_fraction"]["median"] < 0.5  # a blob's middle in an image of 128 px
    assert right["images"]["white_within_a_pixel"] > 0.9
    with pytest.raises(TactipError, match="none of 8 frames shows"):
        sim_to_real_gap(read_samples(lab), design_named("nominal-331"), "draft", 8)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--real-train-frames", "50"], "real_train_frames must be at most 40, so 20 of the 60 frames"),
        (["--design", "cube"], "unknown design 'cube'"),
        (["--init-from", "nobody"], "neither a folder nor a shipped model"),
    ],
)
def test_transfer_wrong_option_reports_error(lab, tmp_path, capsys, options, words):
    command = ["transfer", "zero-shot", "--real", str(lab), "--out", str(tmp_path / "out"), "--real-train-frames", "30"]
    assert tactip.main([*command, *options]) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("option", "value", "choices"),
    [
        ("optics_ranges", "rainbow", "('auto', 'lens', 'lens-jitter', 'lens-salt', 'real', 'rim', "),
        ("randomize_mechanics", "stone", "('auto', 'none', 'estimated', 'real')"),
        ("recipe", "cake", "('laptop', 'paper')"),
        ("fidelity", "exact", "('auto', 'fast', 'draft', 'standard', 'reference')"),
    ],
)
def test_transfer_unknown_choice_lists_choices(tmp_path, capsys, option, value, choices):
    command = ["transfer", "zero-shot", "--real", "nowhere", "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as ended:
        tactip.main([*command, f"--{option}", value])
    assert ended.value.code == 2
    output = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert f"invalid choice '{value}' for argument '--{option.replace('_', '-')}'. Expected one of {choices}" in output


def test_settings_unknown_name_is_refused():
    with pytest.raises(
        TactipError,
        match="unknown optics_ranges 'rainbow': choose one of auto, lens, lens-jitter, lens-salt, real, rim, steady",
    ):
        TransferSettings(optics_ranges="rainbow")
    with pytest.raises(TactipError, match="unknown randomize_mechanics 'stone': choose one of auto, none, estimated, real"):
        TransferSettings(randomize_mechanics="stone")
    with pytest.raises(TactipError, match="unknown recipe 'cake': choose one of laptop, paper"):
        TransferSettings(recipe="cake")


def test_split_default_depends_on_set_size(lab):
    samples = read_samples(lab)
    halves = split_of(samples, TransferSettings())
    assert (len(halves.known), len(halves.test)) == (36, 24)
    many = samples.take(np.arange(3000) % 60)
    assert len(split_of(many, TransferSettings()).known) == 1500
    with pytest.raises(TactipError, match="at least 33 real frames are needed, got 30 in"):
        split_of(samples.take(slice(0, 30)), TransferSettings())


def test_transfer_depth_of_wrong_sign_is_refused(lab, tmp_path, capsys):
    folder, wrong = lab.with_name("other_tip"), ["pose_z=pose_2+5", "pose_Ry=pose_6"]
    assert tactip.main(["import", str(folder), "--out", str(tmp_path / "set"), "--columns", *wrong]) == 0
    assert tactip.main(["transfer", "zero-shot", "--real", str(tmp_path / "set"), "--out", str(tmp_path / "out")]) == 1
    assert "must be negative (into the object)" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_pseudo_real_needs_no_real_data(tiny, tmp_path, capsys):
    command = ["transfer", "pseudo-real", "--out", str(tmp_path / "out"), "--frames", "50", "--gap-frames", "8", *FEW]
    assert tactip.main([*command, "--shots", "10", "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert set(output) == {"zero-shot", "gap", "few-shot"}
    assert output["gap"]["best_fraction"]["median"] < output["gap"]["pins_move"]


def test_hidden_design_depends_on_seed_only(tmp_path, capsys):
    assert hidden_design("nominal-127", 0) == hidden_design("nominal-127", 0) != hidden_design("nominal-127", 1)
    assert hidden_design("nominal-127", 0).optics != design_named("nominal-127").optics
    assert tactip.main(["transfer", "pseudo-real", "--out", str(tmp_path / "out"), "--real", "x"]) == 1
    assert "pseudo-real makes its own set" in capsys.readouterr().err
    assert tactip.main(["transfer", "gap", "--out", str(tmp_path / "none")]) == 1
    assert "gap needs the folder of an imported set: add --real FOLDER" in capsys.readouterr().err


def test_transfer_unknown_experiment_or_missing_neutral_image(lab, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        tactip.main(["transfer", "many-shot", "--real", str(lab), "--out", str(tmp_path / "out")])
    assert ended.value.code == 2
    output = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert "Expected one of ('zero-shot', 'ablate', 'few-shot', 'gap', 'pseudo-real')" in output
    (tmp_path / "set").mkdir()
    with pytest.raises(TactipError, match=r"has no neutral\.png, so it was not made by this version"):
        fit_design_to_neutral_image(tmp_path / "set", 128)


def test_transfer_page_shows_targets(lab, tmp_path, monkeypatch):
    """Errors are compared with targets and with real training; earlier results stay on the page."""

    def figures(depth, tilt):
        values = {"pose_z": depth, "pose_Rx": 0.0, "pose_Ry": tilt}
        inside = {f"coverage_{level}": dict.fromkeys(values, level / 200) for level in (68, 95)}
        varies = {"pose_z": True, "pose_Rx": False, "pose_Ry": True}
        return {"mae": values, "mae_zeroed": values, "varies": varies, **inside}

    zero = {"simulation": figures(0.3, 1.5), "real": figures(0.1, 1.0)}
    earlier = {"fine_tuned": figures(0.2, 2.0)}  # results of an earlier version have it; they are left out
    few = {"0": earlier, "50": {"corrected": figures(0.11, 1.2), **earlier, "alone": figures(0.2, 2.0)}}
    monkeypatch.setattr(transferred, "EXPERIMENTS", {"zero-shot": lambda e: zero, "few-shot": lambda e: few})
    folders = {"runs": tmp_path / "runs", "out": tmp_path / "out", "settings": TransferSettings(real_train_frames=30)}
    options = TransferOptions((lab,), ("zero-shot",), **folders)
    transferred.run(options, log=lambda line: None)
    assert "| set | pose_z | 0.300 mm | 0.3 mm | 3.00 | 2 |  | 1.3 |" in (tmp_path / "out" / "transfer.md").read_text()
    transferred.run(replace(options, experiments=("few-shot",)), log=lambda line: None)
    page = (tmp_path / "out" / "transfer.md").read_text()
    assert "| set | pose_z | 0.300 mm | 0.3 mm | 3.00 | 2 | 1.10 | 1.3 |" in page
    assert "| set | pose_Ry | 1.500 ° | 2 ° | 1.50 | 2 | 1.20 | 1.3 |" in page and "| set | pose_Rx" not in page
    assert "| network | pose_z, 68 % | pose_z, 95 % | pose_Ry, 68 % | pose_Ry, 95 % |" in page
    assert "| trained on 50 real frames only | 34 | 48 | 34 | 48 |" in page and "fine-tuned" not in page
    assert page.index("### set") < page.index("trained on 50 real frames only")
    with pytest.raises(TactipError, match="unknown experiment 'many': choose one of zero-shot, few-shot"):
        transferred.run(replace(options, experiments=("many",)))
    with pytest.raises(TactipError, match="--real must name"):
        transferred.run(replace(options, real=()))
