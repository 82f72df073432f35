"""The page of the servo: each run is made once and kept, and the page gives the reason for a refused one."""

import json
import re
from dataclasses import replace

import pytest

from tactip_twin.benchmarks.servo import servo as followed
from tactip_twin.benchmarks.servo.options import ServoBenchOptions
from tactip_twin.control.options import RouteOptions, Settings
from tactip_twin.tactip_model.errors import TactipError

QUICK = {
    "fidelity": "draft",
    "renderer": "raster",
    "arm": "none",
    "model": "oracle",
    "settings": Settings(alignment_steps=3),
}


@pytest.fixture
def options(tmp_path, monkeypatch):
    """One short run in each group, in this process."""
    plate = replace(followed._LONG["bust"], object="plate", route=RouteOptions("straight", length_mm=1), **QUICK)
    away = replace(plate, position_mm=(5000.0, 0, 0), arm="kinematic")
    runs = [followed.Case("fidelity", "bust, plate", plate), followed.Case("robust", "away", away)]
    runs += [followed.Case("robust", "bust, 2 mm deep", replace(plate, depth_mm=2.0))]
    runs += [followed.Case("objects", "plate", plate), followed.Case("starts", "bust, 0", away)]
    monkeypatch.setattr(followed, "cases", lambda options: runs)
    monkeypatch.setattr(followed, "WorkerPool", _Here)
    return ServoBenchOptions(runs=tmp_path / "runs", out=tmp_path / "out")


class _Here:
    """A worker pool without workers: tasks run in this process."""

    made = 0

    def __init__(self, begin, arguments, tasks, unit, log, named):
        self._do, self._tasks = begin(*arguments), tasks

    def work(self, workers, done):
        for task in self._tasks:
            self._do(task)
            _Here.made += 1


def test_runs_are_made_once_and_stand_on_the_page(options):
    _Here.made = 0
    record = followed.run(options)
    assert list(record["groups"]) == ["objects", "fidelity", "robust", "starts"]
    row = record["groups"]["fidelity"][0]
    score = json.loads((options.runs / "fidelity" / "bust_plate" / "score.json").read_text())
    assert row["depth_mae_mm"] == score["depth_mae_mm"] and row["stopped_because"] == "route completed"
    page = (options.out / "servo.md").read_text()
    assert f"| plate | {row['depth_mae_mm']:.2f} | {row['angle_mean_deg']:.2f} |" in page
    assert "\n- away: the start is out of reach" in page
    assert "| bust | 0 of 1 | nan | nan | 1: the start is out of reach" in page
    assert (options.out / "servo.png").stat().st_size > 3000
    assert _Here.made == 5
    (patch,) = record["patches"]
    assert patch["depth_mm"] == 2 and f"| 2 | {patch['predicted_deg'][0]:.2f} (0.00)" in page
    again = followed.run(replace(options, groups=("robust",)))
    assert _Here.made == 5
    assert again == record
    kept = followed.run(replace(options, groups=("objects",)))
    assert kept["patches"] == record["patches"]


@pytest.mark.slow
def test_groups_keep_the_machine_that_made_them(options, monkeypatch):
    """They also keep the number of runs at a time."""
    monkeypatch.setattr(followed, "machine", lambda: {"processor": "old"})
    followed.run(replace(options, groups=("objects", "fidelity"), workers="1"))
    monkeypatch.setattr(followed, "machine", lambda: {"processor": "new"})
    record = followed.run(replace(options, groups=("objects", "robust"), workers="3"))
    made = {group: (made["machine"]["processor"], made["workers"]) for group, made in record["made"].items()}
    assert made == {"objects": ("old", 1), "fidelity": ("old", 1), "robust": ("new", 3)}
    page = (options.out / "servo.md").read_text()
    states = re.findall(r"^([a-z, ]+): Version .*; (.*), one core each; processor (\w+)\.$", page, re.MULTILINE)
    assert states == [("objects, fidelity", "one run at a time", "old"), ("robust", "3 runs at a time", "new")]


def test_run_without_contact_has_no_patch(options, monkeypatch):
    """One run is refused, and one ends before it follows anything."""
    away, deep = followed.cases(options)[1:3]
    lost = [replace(deep, options=replace(deep.options, task="edge")), replace(deep, options=away.options)]
    lost[1] = replace(lost[1], name="bust, 3 mm deep")
    monkeypatch.setattr(followed, "cases", lambda options: lost)
    record = followed.run(replace(options, groups=("robust",)))
    assert ["error" in row for row in record["groups"]["robust"]] == [True, False]
    assert "patches" not in record


def test_runs_without_figures_are_not_plotted(tmp_path):
    row = {"name": "bust, draft", "steps_per_s": None, "depth_mae_mm": 0.1, "angle_mean_deg": 1.0}
    rows = [row, row | {"steps_per_s": 0.0}, row | {"steps_per_s": 9.0, "depth_mae_mm": None, "angle_mean_deg": None}]
    followed.plot([*rows, {"name": "bust, standard", "error": "it is out of reach"}], tmp_path / "servo.png")
    assert (tmp_path / "servo.png").stat().st_size > 3000


def test_run_with_other_options_is_repeated(options, monkeypatch):
    followed.run(replace(options, groups=("objects",)))
    before, _Here.made = followed.cases(options), 0
    changed = [replace(c, options=replace(c.options, route=RouteOptions("straight", length_mm=2))) for c in before]
    monkeypatch.setattr(followed, "cases", lambda options: changed)
    followed.run(replace(options, groups=("objects",)))
    assert _Here.made == 1


def test_all_groups_have_their_runs():
    every = followed.cases(ServoBenchOptions(other_surface="a"))
    names = [(c.group, c.name) for c in every]
    assert len(set(names)) == len(names)
    assert {c.group for c in every} == set(followed.GROUPS)
    assert sum(c.group == "starts" for c in every) == 6 * followed.STARTS
    assert ("robust", "bust, other network") in names and (
        "robust",
        "rim, other network",
    ) not in names
    starts = [c.options for c in every if c.group == "starts" and c.name.startswith("rim-round")]
    assert len({o.seed for o in starts}) == followed.STARTS and {o.route.reverse for o in starts} == {True, False}


def test_unknown_group_is_refused():
    with pytest.raises(TactipError, match="unknown group 'speed': choose one of objects, oracle, arm"):
        followed.run(ServoBenchOptions(groups=("speed",)))


def test_other_networks_training_set_is_recorded(options):
    """It stays on a page that is written again without it."""
    record = followed.run(replace(options, groups=("robust",), other_surface="surface-curved-tactip-127"))
    output = record["others"]["surface"]
    assert (
        "images of a set of seed 11, 15 snapshots per contact; training of seed 0, with initial weights of another" in output
    )
    again = followed.run(replace(options, groups=("objects",)))
    assert again["others"] == record["others"]
    assert f"Training of the other network of the surface: {output}." in (options.out / "servo.md").read_text()
    assert "others" not in followed.run(replace(options, groups=("robust",)))
