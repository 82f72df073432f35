"""The style of figures."""

import itertools

import cv2
import numpy as np

from tactip_twin.sim.view.plot import figure_of, log_axis, save_figure


def test_log_axis_has_plain_labels_that_do_not_collide(tmp_path):
    figure, (axis,) = figure_of(1, 1, (4, 3))
    axis.plot([1.2, 3, 26], [0.4, 1, 8])
    for name in "xy":
        log_axis(axis, name)
    figure.canvas.draw()
    shown = [label for label in axis.get_xticklabels() if label.get_text() and 1.2 <= float(label.get_text()) <= 26]
    assert [label.get_text() for label in shown] == ["2", "5", "10", "20"]
    boxes = [label.get_window_extent() for label in shown]
    assert all(a.x1 < b.x0 for a, b in itertools.pairwise(boxes))
    save_figure(figure, tmp_path / "a.png")
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image.shape == (600, 800, 3) and np.ptp(image) > 100


def test_save_figure_same_data_give_the_same_bytes(tmp_path):
    for name in ("a.png", "b.png"):
        figure, (axis,) = figure_of(1, 1, (2, 2))
        axis.plot([0, 1])
        save_figure(figure, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
