"""An exported network gives the estimates of torch, in their units, by onnxruntime."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from tactip_twin.commands import main as tactip
from tactip_twin.learning.configuration import RECIPES, PoseNetConfig
from tactip_twin.learning.deviation_scale import DeviationScale
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.model import Model, load_network, shipped_models
from tactip_twin.learning.onnx_export import MAX_DIFFERENCE, _test_images, difference, export_onnx, onnx_bytes, output_names
from tactip_twin.learning.outputs import Layout
from tactip_twin.learning.posenet import PoseNet
from tactip_twin.sim.dataset.sampling import POSE_RANGES
from tactip_twin.tactip_model.errors import TactipError

SMALL = {"conv_layers": 2, "filters": 4, "dense_units": 8}


def untrained(config, size=40, scale=None, task="edge", ranges=POSE_RANGES):
    """Return a model with random weights."""
    low, high = np.delete(ranges[task].bounds(), 1, 0).T.tolist()  # an edge has no place along it
    torch.manual_seed(0)
    labels = Labels(task, tuple(low), tuple(high))
    net = PoseNet(config, size, Layout(config, labels).size)
    for layer in net.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            layer.running_mean.uniform_(-0.1, 0.1)
    return Model(net, config, labels, size, {}, scale)


@pytest.fixture(scope="module", autouse=True)
def installed():
    pytest.importorskip("onnx", reason="the extra onnx is not installed")
    pytest.importorskip("onnxruntime", reason="the extra onnx is not installed")


@pytest.mark.parametrize(
    "config",
    [
        PoseNetConfig(**SMALL),
        PoseNetConfig(**SMALL, activation="elu", batch_norm=True, dense_layers=2, downsample=2),
        PoseNetConfig(**SMALL, group_norm=2, extra_convs=1, blur_px=0.8, deviations=True),
        PoseNetConfig(**SMALL, pixel_unshuffle=True, downsample=2, downsampling="stride", deviations=True, quantities=True),
        PoseNetConfig(**SMALL, quantities=True),
    ],
    ids=["paper", "batch-norm", "blur", "laptop", "quantities"],
)
def test_every_kind_of_network_agrees_with_torch(config):
    model = untrained(config)
    images = np.random.default_rng(1).integers(0, 2, (5, 40, 40), np.uint8) * 255
    assert difference(model, onnx_bytes(model), images) <= MAX_DIFFERENCE


def test_yaw_all_round_agrees_with_torch():
    ranges = {"edge": replace(POSE_RANGES["edge"], yaw_deg=(-180.0, 180.0))}
    model = untrained(PoseNetConfig(**SMALL, deviations=True, quantities=True), ranges=ranges)
    images = np.random.default_rng(1).integers(0, 2, (5, 40, 40), np.uint8) * 255
    assert difference(model, onnx_bytes(model), images) <= MAX_DIFFERENCE


def test_deviations_have_their_fitted_factors():
    config = PoseNetConfig(**SMALL, deviations=True, quantities=True)
    columns = len(untrained(config).columns)
    rng = np.random.default_rng(0)
    factors = tuple(tuple(row) for row in rng.uniform(0.5, 2, (3, columns)).tolist())
    images = rng.integers(0, 2, (20, 40, 40), np.uint8) * 255
    for scale in (DeviationScale((0.05, 0.2, 0.4), factors), DeviationScale((0.0,), factors[:1])):
        model = untrained(config, scale=scale)
        assert difference(model, onnx_bytes(model), images) <= MAX_DIFFERENCE
    plain = Model(model.net, config, model.labels, 40, {})
    assert difference(plain, onnx_bytes(model), images) > MAX_DIFFERENCE


def test_paper_network_agrees_with_torch():
    """The whole network of the paper for the surface, with fewer filters, on images of its size."""
    config = PoseNetConfig(**vars(RECIPES["paper"]["surface"].network) | {"filters": 16})
    model = untrained(config, size=128)
    assert difference(model, onnx_bytes(model), _test_images(model)) <= MAX_DIFFERENCE


@pytest.mark.parametrize("name", shipped_models())
def test_shipped_network_agrees_with_torch(name, tmp_path, capsys):
    import onnx

    assert tactip.main(["export", "--model", name, "--onnx", str(tmp_path / "net.onnx")]) == 0
    model, data = load_network(name), (tmp_path / "net.onnx").read_bytes()
    assert difference(model, data, _test_images(model)[:3]) <= MAX_DIFFERENCE
    content = onnx.load_from_string(data)
    facts = {entry.key: entry.value for entry in content.metadata_props}
    assert facts["task"] == model.labels.task
    assert json.loads(facts["range_low"]) == dict(zip(model.labels.names, model.labels.low, strict=True))
    assert [output.name for output in content.graph.output] == list(output_names(model))
    assert {"pose_z_mm", "deviation_pose_Rx_deg", "force_z_N", "effective_shear_x_mm", "contact_probability"} <= set(
        output_names(model)
    )
    assert "pose_z_mm" in capsys.readouterr().out


def test_file_that_differs_from_torch_is_not_written(tmp_path, monkeypatch):
    model = untrained(PoseNetConfig(**SMALL))
    other = onnx_bytes(model)
    with torch.no_grad():
        model.net.dense[-1].bias += 1e-3
    monkeypatch.setattr("tactip_twin.learning.onnx_export.onnx_bytes", lambda _: other)
    with pytest.raises(TactipError, match=r"differs from torch by .* of an output, allowed is 1e-05"):
        export_onnx(model, tmp_path / "net.onnx")
    assert not list(tmp_path.iterdir())


def test_missing_extra_is_one_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert tactip.main(["export", "--model", "surface-tactip-127", "--onnx", str(tmp_path / "net.onnx")]) == 1
    assert ".venv/bin/pip install -e '.[onnx]'" in capsys.readouterr().err
