"""Evaluation: figures, tables, and sets that do not fit the network."""

import json
from dataclasses import replace

import numpy as np
import pytest

from helpers.learning_sets import write_fake_set, write_fake_splits
from helpers.trainings import NET, QUICK, quiet
from tactip_twin.commands import main as tactip
from tactip_twin.learning.configuration import TrainSettings
from tactip_twin.learning.data import read_samples, read_splits
from tactip_twin.learning.evaluate import binned, evaluate, tables
from tactip_twin.learning.evaluation_page import write_evaluation
from tactip_twin.learning.model import load_model, save_model
from tactip_twin.sim.dataset.format import read_dataset
from tactip_twin.tactip_model.presets import design_named


def test_evaluate_command_mismatched_set_fails(splits, tmp_path, capsys):
    quiet(*splits, NET, QUICK, tmp_path / "run")
    other = write_fake_set(tmp_path / "edge", "edge", samples=4)
    large = write_fake_set(tmp_path / "large", "surface", samples=4, size=64)
    for folder, message in (
        (other, "has the task 'edge', but the model has 'surface'"),
        (large, "64 px wide, but the model uses 40 px"),
    ):
        assert tactip.main(["evaluate", "--model", str(tmp_path / "run"), "--data", str(folder)]) == 1
        assert message in capsys.readouterr().err


def test_evaluate_command_matches_numpy(data, splits, tmp_path, capsys):
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


def test_evaluate_edge_has_five_components(tmp_path):
    data = write_fake_splits(tmp_path / "edge", "edge", samples=8)
    train_set, val = read_splits(data)
    quiet(train_set, val, NET, TrainSettings(epochs=1), tmp_path / "run")
    evaluation = evaluate(load_model(tmp_path / "run"), val)
    assert list(evaluation.figures["mae"]) == ["pose_x", "pose_z", "pose_Rx", "pose_Ry", "pose_Rz"]
    assert train_set.labels.scale.tolist() == [5, 5, 15, 15, 45]


def test_tables_bins_and_worst_samples(data, splits, tmp_path):
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


def test_evaluate_on_a_sensor_with_other_pins_is_refused_unless_asked_for(splits, tmp_path, capsys):
    """Predictions from images of a sensor that was not learned mean nothing; where they are far outside, that is said."""
    quiet(*splits, NET, QUICK, tmp_path / "run")
    other = write_fake_set(tmp_path / "other", samples=4, design=design_named("nominal-331"))
    command = ["evaluate", "--model", str(tmp_path / "run"), "--data", str(other)]
    assert tactip.main(command) == 1
    assert "show 331 pins, but the network was trained on images of 127" in capsys.readouterr().err
    assert tactip.main([*command, "--any-sensor", "--json"]) == 0
    assert 0 <= json.loads(capsys.readouterr().out)["outside_fraction"] <= 1


def test_predictions_far_outside_the_learned_range_are_counted_and_said(splits, tmp_path, capsys):
    quiet(*splits, NET, QUICK, tmp_path / "run")
    model = load_model(tmp_path / "run")
    state = model.net.state_dict()
    state[list(state)[-1]] += 5.0  # the bias of the last layer: five times the learned range
    (tmp_path / "shifted").mkdir()
    save_model(tmp_path / "shifted", state, model.config, model.labels, model.size, model.provenance)
    data = write_fake_set(tmp_path / "set", samples=4)
    assert tactip.main(["evaluate", "--model", str(tmp_path / "shifted"), "--data", str(data), "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["outside_fraction"] == 1
    assert "100% of the predictions are far outside the range that the network learned" in err


def test_constant_components_and_labels_outside_the_range_are_told(data, splits, tmp_path):
    quiet(*splits, NET, QUICK, tmp_path / "run")
    model, samples = load_model(tmp_path / "run"), read_samples(data / "test")
    labels = model.labels
    model = replace(model, labels=replace(labels, low=(labels.low[0], labels.low[1] / 2, labels.low[2])))
    samples.targets[:, 2] = 0.3
    evaluation = evaluate(model, samples)
    assert evaluation.figures["varies"] == {"pose_z": True, "pose_Rx": True, "pose_Ry": False}
    fractions = evaluation.figures["labels_outside"]
    assert fractions["pose_Rx"] == (samples.targets[:, 1] < labels.low[1] / 2).mean() > 0.1
    assert fractions["pose_z"] == fractions["pose_Ry"] == 0
    write_evaluation(evaluation, samples, model, tmp_path / "report")
    page = (tmp_path / "report" / "evaluation.md").read_text()
    assert "leaves out pose_Ry, which hardly varies" in page
    assert f"| {100 * fractions['pose_Rx']:.1f} % |" in page
