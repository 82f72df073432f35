"""PoseNet: layers, configuration, penalties, schedules and recipes."""

from itertools import pairwise

import pytest
import torch
from torch import nn

from tactip_twin.learning.configuration import RECIPES, PoseNetConfig, SearchSpace, TrainSettings
from tactip_twin.learning.posenet import PoseNet, parameter_count
from tactip_twin.learning.recipes import recipe_named
from tactip_twin.learning.search_space import network_of_point
from tactip_twin.learning.training import cosine_rate, paper_rate
from tactip_twin.tactip_model.errors import TactipError

SMALL = PoseNetConfig(conv_layers=2, filters=3, dense_layers=2, dense_units=4, dropout=0.3)


def kinds(module):
    return [type(layer) for layer in module]


def test_posenet_default_layers_match_paper():
    net = PoseNet(SMALL, 40, 3)
    assert kinds(net.convolutions) == [nn.Conv2d, nn.MaxPool2d, nn.ReLU] * 2
    assert kinds(net.dense) == [nn.Dropout, nn.Linear, nn.ReLU] * 2 + [nn.Dropout, nn.Linear]
    for layer in net.convolutions:
        if isinstance(layer, nn.Conv2d):
            assert (layer.kernel_size, layer.stride, layer.padding) == ((3, 3), (1, 1), (0, 0))
    # 40 → 38 → 19 → 17 → 8
    sizes = [3 * 9 + 3, 3 * 3 * 9 + 3, 3 * 64 * 4 + 4, 4 * 4 + 4, 4 * 3 + 3]
    assert parameter_count(net) == sum(sizes)
    assert net(torch.zeros(5, 1, 40, 40)).shape == (5, 3)


@pytest.mark.parametrize("name", ["relu", "elu"])
def test_posenet_batch_norm_precedes_activation(name):
    config = PoseNetConfig(conv_layers=1, filters=2, activation=name, batch_norm=True)
    activation = {"relu": nn.ReLU, "elu": nn.ELU}[name]
    assert kinds(PoseNet(config, 20, 1).convolutions) == [nn.Conv2d, nn.BatchNorm2d, activation, nn.MaxPool2d]


def test_posenet_group_norm_is_independent_of_batch():
    config = PoseNetConfig(conv_layers=2, filters=6, filter_growth=2, downsampling="stride", group_norm=4, dropout=0.0)
    net = PoseNet(config, 40, 2)
    norms = [m for m in net.convolutions if isinstance(m, nn.GroupNorm)]
    assert [(m.num_groups, m.num_channels) for m in norms] == [(1, 6), (3, 12)]
    images = torch.rand(5, 1, 40, 40, generator=torch.Generator().manual_seed(0))
    together = net(images)  # in training mode
    assert torch.allclose(together, torch.cat([net(image[None]) for image in images]), atol=1e-5)
    with pytest.raises(TactipError, match="0 with batch norm"):
        PoseNetConfig(batch_norm=True, group_norm=4)


@pytest.mark.parametrize("name", ["relu", "elu"])
def test_posenet_without_norm_pooling_commutes_with_activation(name):
    net = PoseNet(PoseNetConfig(conv_layers=1, filters=4, activation=name), 20, 1).convolutions
    image = torch.randn(3, 1, 20, 20, generator=torch.Generator().manual_seed(0))
    papers = nn.Sequential(net[0], net[2], net[1])
    # Vectorized and scalar ELU may differ by rounding.
    torch.testing.assert_close(net(image), papers(image), rtol=4 * torch.finfo(torch.float32).eps, atol=1e-7)


def test_posenet_stride_and_further_have_expected_layers():
    config = PoseNetConfig(conv_layers=3, filters=2, downsampling="stride", extra_convs=1, batch_norm=True)
    net = PoseNet(config, 40, 1)
    layer = [nn.Conv2d, nn.BatchNorm2d, nn.ReLU]
    assert kinds(net.convolutions) == layer * 6
    # 40 → 19 → 8 → 3
    assert net.convolutions(torch.zeros(2, 1, 40, 40)).shape == (2, 2, 3, 3)
    assert config.last_size(40) == 3


def test_config_unknown_halving_raises():
    with pytest.raises(TactipError, match="unknown downsampling 'mean': choose one of pool, stride"):
        PoseNetConfig(downsampling="mean")


def test_recipe_paper_matches_table_2():
    """Table 2: five convolutions of 512 and of 256 filters leave 2×2 of 128×128 pixels."""
    surface, edge = (recipe_named("paper", task).network for task in ("surface", "edge"))
    assert (surface.conv_layers, surface.filters, surface.dense_layers, surface.dense_units) == (5, 512, 1, 16)
    assert (edge.conv_layers, edge.filters, edge.dense_layers, edge.dense_units) == (5, 256, 2, 512)
    assert surface.last_size(128) == edge.last_size(128) == 2
    assert recipe_named("paper", "edge").settings == TrainSettings()


@pytest.mark.parametrize(("layers", "size", "allowed"), [(6, 128, 5), (2, 6, 1), (1, 3, 0)])
def test_posenet_too_many_layers_raises(layers, size, allowed):
    with pytest.raises(TactipError, match=f"conv_layers must be at most {allowed}: an image of {size} px.*, got {layers}"):
        PoseNet(PoseNetConfig(conv_layers=layers, filters=2), size, 3)


def test_penalty_covers_dense_and_output_weights_only():
    net = PoseNet(PoseNetConfig(conv_layers=1, filters=2, dense_units=3, l1=0.5, l2=0.25), 8, 2)
    weights = torch.cat([layer.weight.flatten() for layer in net.dense if isinstance(layer, nn.Linear)])
    assert net.penalty().item() == pytest.approx((0.5 * weights.abs().sum() + 0.25 * (weights**2).sum()).item())
    with torch.no_grad():
        net.convolutions[0].weight.fill_(1e3)
        for layer in net.dense:
            if isinstance(layer, nn.Linear):
                layer.bias.fill_(1e3)
                layer.weight.zero_()
    assert net.penalty().item() == 0


def test_posenet_blur_and_reduce_keep_brightness():
    net = PoseNet(PoseNetConfig(conv_layers=1, filters=2, blur_px=1.0, downsample=2), 40, 3)
    image = torch.zeros(1, 1, 40, 40)
    image[0, 0, 20, 20] = 1.0
    out = net.convolutions[0](image)
    assert out.shape == (1, 1, 20, 20)
    assert 4 * out.sum().item() == pytest.approx(1.0, abs=1e-5)
    v, u = torch.meshgrid(torch.arange(20.0), torch.arange(20.0), indexing="ij")
    assert (out[0, 0] * u).sum().item() / out.sum().item() == pytest.approx(9.75, abs=0.01)
    assert (out[0, 0] * v).sum().item() / out.sum().item() == pytest.approx(9.75, abs=0.01)


def test_posenet_fold_keeps_every_pixel():
    """A pixel that moves within its square changes the folded channels but not the mean."""
    images = torch.zeros(2, 1, 40, 40)
    images[0, 0, 20, 20] = images[1, 0, 21, 21] = 1.0
    torch.manual_seed(0)
    for fold in (False, True):
        net = PoseNet(PoseNetConfig(conv_layers=2, filters=4, downsample=2, pixel_unshuffle=fold), 40, 3).eval()
        with torch.no_grad():
            one, other = net(images)
        assert torch.allclose(one, other) != fold
    with pytest.raises(TactipError, match=r"downsample must be above 1 with pixel_unshuffle, got 1"):
        PoseNetConfig(pixel_unshuffle=True)


def test_widths_stop_at_most_filters():
    assert PoseNetConfig(conv_layers=4, filters=8, filter_growth=2, max_filters=20).widths() == [8, 16, 20, 20]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"conv_layers": 0}, "conv_layers must be a whole number from 1 to 8, got 0"),
        ({"filters": 2.5}, "filters must be a whole number .*, got 2.5"),
        ({"filters": [32]}, r"filters must be a whole number .*, got \[32\]"),
        ({"dropout": 1.0}, "dropout must be a finite number from 0 to 0.9, got 1.0"),
        ({"activation": "tanh"}, "choose one of relu, elu"),
    ],
)
def test_config_invalid_value_raises(changes, message):
    with pytest.raises(TactipError, match=message):
        PoseNetConfig(**changes)


def test_learning_rate_schedules():
    settings = TrainSettings(learning_rate=0.1, learning_rate_decay=0.5)
    assert paper_rate(settings, 0, 10) == 0.1
    assert paper_rate(settings, 2, 10) == pytest.approx(0.05)
    rates = [cosine_rate(settings, step, 100) for step in range(101)]
    assert max(rates) == pytest.approx(0.1, rel=0.02)
    assert rates[0] < 0.03 and rates[-1] < 1e-12
    assert all(a >= b for a, b in pairwise(rates[5:]))


def test_recipes_accept_128_px_images():
    for by_task in RECIPES.values():
        for recipe in by_task.values():
            assert recipe.network.last_size(128) >= 1


def test_search_space_contains_paper_network_and_checks_image_size():
    point = {"conv_layers": 5, "log2_filters": 9, "dense_layers": 1, "log2_units": 4, "activation": "relu"}
    point |= {"batch_norm": False, "dropout": 0.001, "l1": 0.001, "l2": 0.064, "batch_size": 32}
    assert network_of_point(SearchSpace(), point) == PoseNetConfig()
    small = SearchSpace(max_conv_layers=4, downsample=2, blur_px=1.0)
    assert network_of_point(small, point) == PoseNetConfig(downsample=2, blur_px=1.0)
    with pytest.raises(TactipError, match=r"conv_layers must be at most 5.*, got 7"):
        SearchSpace(max_conv_layers=7).check_image_size(128)
    with pytest.raises(TactipError, match="at most 4: an image of 128 px"):
        SearchSpace(max_conv_layers=5, downsample=2).check_image_size(128)
