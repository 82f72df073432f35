"""Training keeps its promises: the same from its seed, the same after a kill, and errors before it starts."""

import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.learning_sets import write_fake_set, write_fake_splits
from tactip_twin.commands import main as tactip
from tactip_twin.learning import checkpoint
from tactip_twin.learning import train as train_module
from tactip_twin.learning.checkpoint import read_metrics
from tactip_twin.learning.configuration import PoseNetConfig, Recipe, TrainSettings
from tactip_twin.learning.data import read_samples, read_splits
from tactip_twin.learning.evaluate import binned, evaluate, tables
from tactip_twin.learning.model import load_model, net_sha256, to_input
from tactip_twin.learning.muon import Muon, inner_weights
from tactip_twin.learning.recipes import read_recipe, recipe_json
from tactip_twin.learning.train import train
from tactip_twin.learning.training import Training, TrainingDiverged
from tactip_twin.sim.dataset.format import encode_image, read_dataset
from tactip_twin.sim.dataset.sampling import POSE_RANGES
from tactip_twin.tactip_model.errors import Interrupted, TactipError

NET = PoseNetConfig(conv_layers=2, filters=6, units=24, dropout=0.1, l1=0, l2=1e-5, batch_size=8)
QUICK = TrainSettings(epochs=4, rate=3e-3)
TACTIP = str(Path(sys.executable).parent / "tactip")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_fake_splits(tmp_path_factory.mktemp("sets") / "surface", samples=48)


@pytest.fixture(scope="module")
def splits(data):
    return read_splits(data)


def weights(folder):
    return torch.load(folder / "model.pt", weights_only=True)


def same(a, b):
    return all(torch.equal(a[k], b[k]) for k in a) and a.keys() == b.keys()


def quiet(*arguments, **options):
    return train(*arguments, log=lambda line: None, quiet=True, **options)


def test_a_small_set_is_gone_through_more_often(splits):
    """48 images are six steps of eight: 20 steps take four times through."""
    assert Training(*splits, NET, TrainSettings(epochs=2, least_steps=20)).epochs == 4
    assert Training(*splits, NET, TrainSettings(epochs=5, least_steps=20)).epochs == 5


def test_a_set_without_pins_is_trained_on_as_it_is(data, tmp_path, capsys):
    """The recipe draws images anew, for which a real set has no pins; asked for by name, that is refused."""
    command = ["train", "--data", str(data), "--network.conv-layers", "1", "--training.least-steps", "1"]
    command += ["--training.epochs", "1"]
    assert tactip.main([*command, "--out", str(tmp_path / "run")]) == 0
    assert "has no pins: its images are taken as they are" in capsys.readouterr().err
    assert load_model(tmp_path / "run").provenance["settings"]["drawn"] == 0
    assert tactip.main([*command, "--out", str(tmp_path / "other"), "--training.drawn", "1"]) == 1
    assert "only simulated sets, which have pins" in capsys.readouterr().err
    assert not (tmp_path / "other" / "model.json").exists()


@pytest.mark.parametrize("shape", [(6, 20), (20, 6), (8, 3, 4, 4)])
def test_a_step_of_muon_is_nearly_orthogonal(shape):
    """Its singular values are near one, whatever those of the gradient; its directions are the gradient's."""
    torch.manual_seed(0)
    weight = torch.nn.Parameter(torch.zeros(shape))
    gradient = torch.randn(shape).reshape(shape[0], -1)
    left, values, right = torch.linalg.svd(gradient, full_matrices=False)
    gradient = left @ torch.diag(torch.logspace(0, -1.5, len(values))) @ right
    weight.grad = gradient.reshape(shape)
    Muon([weight], lr=0.1).step()
    stretch = max(1, shape[0] / gradient.shape[1]) ** 0.5
    moved = -weight.detach().reshape(shape[0], -1) / (0.1 * stretch)
    seen = left.T @ moved @ right.T
    assert torch.allclose(seen, torch.diag(seen.diagonal()), atol=1e-4)
    assert 0.6 < seen.diagonal().min() < seen.diagonal().max() < 1.3


def test_muon_takes_the_weights_between_layers_and_learns(splits):
    settings = TrainSettings(epochs=8, rate=2e-3, muon=0.02)
    training = Training(*splits, NET, settings)
    inner = inner_weights(training.net)
    assert [tuple(p.shape) for p in inner] == [(6, 6, 3, 3), (24, 6 * 8 * 8)]
    for _ in range(8):
        training.train_epoch()
    adam = Training(*splits, NET, TrainSettings(epochs=8, rate=2e-3))
    for _ in range(8):
        adam.train_epoch()
    assert training.history[-1]["loss"] < adam.history[-1]["loss"]


def test_it_learns(splits, tmp_path):
    """The pictures tell the labels: far better than the mean does."""
    history = quiet(*splits, NET, TrainSettings(epochs=60, patience=60, rate=3e-3), tmp_path / "run")
    val = splits[1]
    by_mean = (((val.targets - splits[0].targets.mean(0)) / val.labels.scale) ** 2).sum(1).mean()
    assert min(h["val_loss"] for h in history) < 0.1 * by_mean
    model = load_model(tmp_path / "run")
    error = ((model.predict(val.images) - val.targets) / val.labels.scale) ** 2
    assert error.sum(1).mean() == pytest.approx(min(h["val_loss"] for h in history), rel=1e-4)


def test_half_precision_learns_as_well(splits):
    """Convolutions and Muon's factor in bfloat16 end where single precision does, to a few per cent of the way there."""
    ends = []
    for precision in ("float32", "bfloat16"):
        training = Training(*splits, NET, TrainSettings(epochs=12, rate=2e-3, muon=0.02, precision=precision))
        for _ in range(12):
            training.train_epoch()
        ends.append(training.history)
    start = ends[0][0]["loss"]
    assert ends[0][-1]["loss"] < 0.3 * start
    assert ends[1] != ends[0]
    assert ends[1][-1]["loss"] == pytest.approx(ends[0][-1]["loss"], abs=0.05 * start)


def test_the_same_seed_gives_the_same_network(splits, tmp_path):
    for name in ("a", "b"):
        quiet(*splits, NET, QUICK, tmp_path / name)
    quiet(*splits, NET, TrainSettings(epochs=4, rate=3e-3, seed=1), tmp_path / "c")
    assert same(weights(tmp_path / "a"), weights(tmp_path / "b"))
    assert not same(weights(tmp_path / "a"), weights(tmp_path / "c"))


def test_training_leaves_the_global_generator_alone(splits, tmp_path):
    before = torch.random.get_rng_state()
    quiet(*splits, NET, TrainSettings(epochs=1), tmp_path / "run")
    assert torch.equal(before, torch.random.get_rng_state())


@pytest.mark.parametrize("epochs", [1, 4])
def test_a_kill_after_the_last_checkpoint_loses_nothing(splits, tmp_path, monkeypatch, epochs):
    """The checkpoint is written first: what is made of it is made anew."""
    settings = TrainSettings(epochs=epochs, rate=3e-3)
    quiet(*splits, NET, settings, tmp_path / "whole")
    save = train_module.save_checkpoint

    def killed(training, folder, record):
        if not training.finished:
            return save(training, folder, record)
        with monkeypatch.context() as patch:
            patch.setattr(checkpoint, "save_model", _cut)
            return save(training, folder, record)

    def _cut(*_):
        raise SystemError("killed")

    with monkeypatch.context() as patch:
        patch.setattr(train_module, "save_checkpoint", killed)
        with pytest.raises(SystemError):
            quiet(*splits, NET, settings, tmp_path / "killed")
    history = quiet(*splits, NET, settings, tmp_path / "killed")
    assert same(weights(tmp_path / "whole"), weights(tmp_path / "killed"))
    outcome = load_model(tmp_path / "killed").provenance["outcome"]
    assert outcome == load_model(tmp_path / "whole").provenance["outcome"]
    assert outcome["finished"] and outcome["epochs"] == len(history) == epochs
    assert not (tmp_path / "killed" / "checkpoint.pt").exists()


def test_a_training_that_is_killed_goes_on_to_the_same_network(data, splits, tmp_path):
    settings = ["--training.epochs", "40", "--training.patience", "40", "--training.rate", "0.003"]
    network = ["--network.conv-layers", "2", "--network.filters", "6", "--network.units", "24", "--network.batch-size", "8"]
    command = [TACTIP, "train", "--data", str(data), "--recipe", "paper", *settings, *network]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    subprocess.run([*command, "--out", str(whole)], check=True, capture_output=True)
    process = subprocess.Popen([*command, "--out", str(killed)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    end = time.monotonic() + 60
    while not (killed / "metrics.jsonl").exists() or len(read_metrics(killed)) < 3:
        assert time.monotonic() < end
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (killed / "checkpoint.pt").exists()
    again = subprocess.run([*command, "--out", str(killed)], check=True, capture_output=True, text=True)
    assert "going on after epoch" in again.stderr
    assert same(weights(whole), weights(killed))
    losses = [[(h["epoch"], h["loss"], h["val_loss"]) for h in read_metrics(f)] for f in (whole, killed)]
    assert losses[0] == losses[1]
    assert not (killed / "checkpoint.pt").exists()
    assert "finished already" in subprocess.run([*command, "--out", str(killed)], capture_output=True, text=True).stderr


def test_it_stops_early_and_keeps_the_best(splits, tmp_path):
    history = quiet(*splits, NET, TrainSettings(epochs=300, patience=3, rate=0.02), tmp_path / "run")
    losses = [h["val_loss"] for h in history]
    assert len(losses) < 300
    assert int(np.argmin(losses)) == len(losses) - 4
    outcome = load_model(tmp_path / "run").provenance["outcome"]
    assert outcome["best_epoch"] == len(losses) - 3
    assert outcome["finished"]


def test_a_loss_that_is_no_number_is_seen(splits):
    training = Training(*splits, NET, QUICK)
    with torch.no_grad():
        training.net.dense[1].weight.fill_(float("nan"))
    with pytest.raises(TrainingDiverged, match="the training diverged"):
        training.train_epoch()


def test_a_folder_is_one_commands_at_a_time(splits, tmp_path):
    def again(history):
        with pytest.raises(TactipError, match="another command is training in"):
            quiet(*splits, NET, QUICK, tmp_path / "run")
        return False

    quiet(*splits, NET, QUICK, tmp_path / "run", should_prune=again)
    assert load_model(tmp_path / "run").provenance["outcome"]["finished"]


def test_a_training_from_before_a_setting_existed_is_known(splits, tmp_path):
    """What a new field's default stands for is what was done before there was the field."""
    history = quiet(*splits, NET, QUICK, tmp_path / "run")
    path = tmp_path / "run" / "model.json"
    description = json.loads(path.read_text())
    del description["provenance"]["network"]["fold"], description["provenance"]["settings"]["optics"]
    path.write_text(json.dumps(description))
    assert quiet(*splits, NET, QUICK, tmp_path / "run") == history
    description["provenance"]["network"]["filters"] += 1
    path.write_text(json.dumps(description))
    with pytest.raises(TactipError, match=r"holds a training with other settings \(network.filters is 7 there, 6 here\)"):
        quiet(*splits, NET, QUICK, tmp_path / "run")


def test_another_training_in_the_folder_is_refused(splits, tmp_path):
    quiet(*splits, NET, QUICK, tmp_path / "run")
    with pytest.raises(TactipError, match=r"holds a training with other settings \(settings.epochs is 4 there, 5 here\)"):
        quiet(*splits, NET, TrainSettings(epochs=5), tmp_path / "run")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("mine")
    with pytest.raises(TactipError, match="holds no training"):
        quiet(*splits, NET, QUICK, tmp_path / "other")


def test_a_training_begins_with_a_network(splits, tmp_path):
    """It begins with what the other one says, also where labels have other ranges, and with nothing else."""
    quiet(*splits, NET, QUICK, tmp_path / "first")
    first = load_model(tmp_path / "first")
    ranges = replace(POSE_RANGES["surface"], depth_mm=(-10, -1), roll_deg=(-5, 5))
    wider = read_splits(write_fake_splits(tmp_path / "wider", pose=ranges))
    training = Training(*wider, NET, QUICK, init_from=first)
    begun = training.net.eval()(to_input(torch.from_numpy(wider[1].images))).detach().numpy() * training.labels.scale
    np.testing.assert_allclose(begun, first.predict(wider[1].images), rtol=1e-4, atol=1e-3)

    quiet(*splits, NET, QUICK, tmp_path / "second", init_from=first)
    assert load_model(tmp_path / "second").provenance["begun_from"] == net_sha256(first.net)
    assert read_metrics(tmp_path / "second")[0]["loss"] < read_metrics(tmp_path / "first")[0]["loss"]
    begun_from = f'"{net_sha256(first.net)}"'
    for folder, start, there, here in (("first", first, "null", begun_from), ("second", None, begun_from, "null")):
        message = f"holds a training with other settings \\(begun_from is {there} there, {here} here\\)"
        with pytest.raises(TactipError, match=message):
            quiet(*splits, NET, QUICK, tmp_path / folder, init_from=start)
    with pytest.raises(TactipError, match=r"other layers than what is trained: units 24, not 8$"):
        quiet(*splits, replace(NET, units=8), QUICK, tmp_path / "third", init_from=first)
    assert not (tmp_path / "third").exists()


def test_a_network_to_begin_with_by_name(data, splits, tmp_path, capsys):
    """Its layers are taken; one of other layers, or of another width of image, is refused by a sentence."""
    quiet(*splits, NET, QUICK, tmp_path / "first")
    given = ["train", "--data", str(data), "--training.epochs", "1", "--training.least-steps", "0"]
    given += ["--training.drawn", "0"]
    assert tactip.main([*given, "--out", str(tmp_path / "on"), "--start", str(tmp_path / "first")]) == 0
    assert load_model(tmp_path / "on").config == NET
    assert tactip.main([*given, "--out", str(tmp_path / "off"), "--start", "surface-tactip-127"]) == 1
    assert "other width of images" in capsys.readouterr().err
    assert not (tmp_path / "off").exists()


@pytest.mark.parametrize("damage", [lambda b: b"rubbish", lambda b: b[: len(b) // 2], lambda b: b""])
def test_a_damaged_checkpoint_is_a_sentence(splits, tmp_path, damage):
    with pytest.raises(Interrupted):
        quiet(*splits, NET, QUICK, tmp_path / "run", should_prune=_stop)
    path = tmp_path / "run" / "checkpoint.pt"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(TactipError, match="remove it to begin anew"):
        quiet(*splits, NET, QUICK, tmp_path / "run")


def test_ctrl_c_keeps_the_epochs_that_are_over(splits, tmp_path):
    with pytest.raises(Interrupted, match="the same command goes on"):
        quiet(*splits, NET, QUICK, tmp_path / "stopped", should_prune=_stop)
    assert len(read_metrics(tmp_path / "stopped")) == 2
    quiet(*splits, NET, QUICK, tmp_path / "stopped")
    quiet(*splits, NET, QUICK, tmp_path / "whole")
    assert same(weights(tmp_path / "stopped"), weights(tmp_path / "whole"))


def _stop(history):
    """Ctrl-C after the second epoch."""
    if len(history) == 2:
        raise KeyboardInterrupt
    return False


def test_weights_of_components(splits):
    """One over the greatest value squared, summed over components."""
    training = Training(*splits, NET, QUICK)
    _, val = splits
    with torch.no_grad():
        for parameter in training.net.parameters():
            parameter.zero_()
    expected = ((val.targets / [5, 15, 15]) ** 2).sum(1).mean()
    assert training.error(training._val_images, training._val_targets) == pytest.approx(expected, rel=1e-5)


# Wrong input: a sentence each, before training.


def damaged(tmp_path, damage):
    folder = write_fake_splits(tmp_path / "data", samples=6)
    damage(folder / "train")
    return folder


def edit_row(column, value):
    def damage(folder):
        lines = (folder / "targets.csv").read_text().splitlines()
        at = lines[0].split(",").index(column)
        cells = lines[3].split(",")
        cells[at] = value
        lines[3] = ",".join(cells)
        (folder / "targets.csv").write_text("\n".join(lines) + "\n")

    return damage


def keep_header(folder):
    (folder / "targets.csv").write_text((folder / "targets.csv").read_text().splitlines()[0] + "\n")


def resize_one(folder):
    (folder / "images" / "image_00002.png").write_bytes(encode_image(np.zeros((20, 20), np.uint8)))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (keep_header, "is empty: there is nothing to learn from"),
        (edit_row("pose_z", "nan"), "pose_z of image_00002.png .* is nan: the set declares -5 to -1 mm"),
        (edit_row("pose_Rx", "15.2"), "pose_Rx of image_00002.png .* is 15.2: the set declares -15 to 15 °"),
        (edit_row("pose_z", "deep"), "a cell that is no number"),
        (edit_row("shear_x", "inf"), "the shear of image_00002.png .* is not a number"),
        (lambda f: (f / "images" / "image_00001.png").write_bytes(b"no image"), "image_00001.png cannot be read"),
        (resize_one, "image_00002.png .* is 20 by 20 px and the first one 40 by 40"),
        (lambda f: (f / "meta.json").unlink(), "there is no data set in"),
    ],
)
def test_damaged_sets_are_refused_before_training(tmp_path, capsys, damage, message):
    folder = damaged(tmp_path, damage)
    with pytest.raises(TactipError, match=message):
        read_splits(folder)
    assert tactip.main(["train", "--data", str(folder), "--out", str(tmp_path / "run")]) == 1
    assert not (tmp_path / "run").exists()
    assert capsys.readouterr().err.startswith("tactip: ")


def test_mixed_sets_are_refused(tmp_path):
    folder = tmp_path / "data"
    write_fake_set(folder / "train", "surface", samples=4)
    write_fake_set(folder / "val", "edge", "val", samples=4)
    with pytest.raises(TactipError, match=r"is of the task 'edge', the training set in .* of 'surface'"):
        read_splits(folder)
    with pytest.raises(TactipError, match="there is no folder"):
        read_splits(tmp_path / "nothing")


def test_a_model_and_a_set_that_do_not_fit_are_refused(splits, tmp_path, capsys):
    quiet(*splits, NET, QUICK, tmp_path / "run")
    other = write_fake_set(tmp_path / "edge", "edge", samples=4)
    large = write_fake_set(tmp_path / "large", "surface", samples=4, size=64)
    for folder, message in (
        (other, "of the task 'edge', the model of 'surface'"),
        (large, "64 px wide, the model takes 40 px"),
    ):
        assert tactip.main(["evaluate", "--model", str(tmp_path / "run"), "--data", str(folder)]) == 1
        assert message in capsys.readouterr().err


def test_damaged_models_are_refused(splits, tmp_path):
    quiet(*splits, NET, QUICK, tmp_path / "run")
    with pytest.raises(TactipError, match="there is no model in"):
        load_model(tmp_path)
    data = (tmp_path / "run" / "model.pt").read_bytes()
    (tmp_path / "run" / "model.pt").write_bytes(data[:-1] + b"x")
    with pytest.raises(TactipError, match="are not those that it names"):
        load_model(tmp_path / "run")
    description = (tmp_path / "run" / "model.json").read_text()
    (tmp_path / "run" / "model.json").write_text(description.replace('"task": "surface"', '"task": "ceiling"'))
    with pytest.raises(TactipError, match="unknown task 'ceiling': choose one of surface, edge"):
        load_model(tmp_path / "run")
    (tmp_path / "run" / "model.json").write_text("{")
    with pytest.raises(TactipError, match="cannot be used"):
        load_model(tmp_path / "run")


def test_recipe_files(tmp_path):
    recipe = Recipe(NET, QUICK)
    (tmp_path / "good.json").write_text(recipe_json(recipe))
    assert read_recipe(tmp_path / "good.json") == recipe
    for text, message in (
        ("{", "is no configuration"),
        ('{"network": {"depth": 3}}', "names depth: it may name conv_layers"),
        ('{"network": {"filters": "many"}}', "filters must be a whole number from 1 to 1024, got many"),
    ):
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(TactipError, match=message):
            read_recipe(tmp_path / "bad.json")


# Evaluation.


def test_evaluation_is_what_numpy_says(data, splits, tmp_path, capsys):
    quiet(*splits, NET, QUICK, tmp_path / "run")
    arguments = ["evaluate", "--model", str(tmp_path / "run"), "--data", str(data / "test")]
    assert tactip.main([*arguments, "--json", "--out", str(tmp_path / "report")]) == 0
    figures = json.loads(capsys.readouterr().out)
    model, samples = load_model(tmp_path / "run"), read_samples(data / "test")
    errors = model.predict(samples.images) - read_dataset(data / "test").poses[:, [2, 3, 4]]
    names = ["pose_z", "pose_Rx", "pose_Ry"]
    for key, expected in (
        ("mae", np.abs(errors).mean(0)),
        ("rmse", np.sqrt((errors**2).mean(0))),
        ("bias", errors.mean(0)),
    ):
        assert list(figures[key]) == names
        assert list(figures[key].values()) == pytest.approx(expected.tolist(), abs=1e-5)
    assert figures["samples"] == 48
    assert figures["latency_ms"] > 0
    assert figures["parameters"] == sum(p.numel() for p in model.net.parameters())
    page = (tmp_path / "report" / "evaluation.md").read_text()
    assert f"{figures['mae']['pose_z']:.3f} mm" in page
    assert {f.name for f in (tmp_path / "report").iterdir()} == {
        "evaluation.json",
        "evaluation.md",
        "errors.png",
        "worst.png",
    }
    assert tactip.main(arguments) == 0
    assert "pose_Ry: mean error" in capsys.readouterr().out


def test_the_components_of_an_edge(tmp_path):
    data = write_fake_splits(tmp_path / "edge", "edge", samples=8)
    train_set, val = read_splits(data)
    quiet(train_set, val, NET, TrainSettings(epochs=1), tmp_path / "run")
    evaluation = evaluate(load_model(tmp_path / "run"), val)
    assert list(evaluation.figures["mae"]) == ["pose_x", "pose_z", "pose_Rx", "pose_Ry", "pose_Rz"]
    assert train_set.labels.scale.tolist() == [5, 5, 15, 15, 45]


def test_bins_and_worst_cases(data, splits, tmp_path):
    values, errors = np.arange(20.0), np.stack([np.arange(20.0), np.ones(20)], 1)
    rows = binned(values, errors, ("a", "b"))
    assert [r["samples"] for r in rows] == [2] * 10
    assert rows[3]["mae"] == {"a": 6.5, "b": 1.0}
    assert rows[3]["from"] == 6 and rows[3]["to"] == 7
    quiet(*splits, NET, QUICK, tmp_path / "run")
    model, samples = load_model(tmp_path / "run"), read_samples(data / "test")
    evaluation = evaluate(model, samples)
    worst = tables(evaluation, samples, model.labels)["worst"]
    size = ((evaluation.errors / model.labels.scale) ** 2).sum(1)
    assert worst[0]["image"] == samples.dataset.images[int(size.argmax())]
