"""How command lines become commands."""

import json
import re
import subprocess
import sys
from dataclasses import asdict

import pytest

from tactip_twin.commands import main as tactip
from tactip_twin.commands._help_text import fields_named
from tactip_twin.commands._parsing import last_value
from tactip_twin.commands.camera import Camera
from tactip_twin.commands.dataset import Make
from tactip_twin.commands.import_set import Import
from tactip_twin.commands.servo import Servo
from tactip_twin.commands.train import Train
from tactip_twin.commands.transfer import Transfer
from tactip_twin.commands.tune import Tune
from tactip_twin.commands.view import View
from tactip_twin.learning.configuration import RECIPES, SearchSpace
from tactip_twin.learning.recipes import read_recipe
from tactip_twin.sim.contact.stimuli import STIMULI
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, Ranges


def train(*options):
    return Train.parse(["--data", "none", "--out", "none", *options], "tactip train")


def sets_of(tmp_path, *options):
    made = Make.parse(["--out", str(tmp_path), *options], "tactip dataset make")
    makes = getattr(made, "makes", (made,))
    return [job.configuration for make in makes for job in make.jobs()]


def refusal(capsys, *arguments):
    """Return the exit status of a refused command line, and what it printed."""
    with pytest.raises(SystemExit) as ended:
        tactip.main(list(arguments))
    return ended.value.code, capsys.readouterr().err


def test_last_value_is_that_of_the_last_mention():
    assert last_value(["--a", "1", "--b=2", "--a=3"], "a") == "3"
    assert last_value(["--a=3", "--a", "1"], "a") == "1"
    assert last_value(["--ab", "1"], "a") is None
    assert last_value(["--a"], "a") is None


@pytest.mark.parametrize("name", ["laptop", "paper"])
def test_train_defaults_are_the_recipes(name):
    command = train("--recipe", name)
    assert (command.network, command.training) == (RECIPES[name]["surface"].network, RECIPES[name]["surface"].settings)


def test_train_explicit_option_wins_over_the_recipe_where_it_equals_the_class_default():
    command = train("--network.filters", "512", "--training.augmented_fraction", "0")
    recipe = RECIPES["laptop"]["surface"]
    assert command.network == type(recipe.network)(**asdict(recipe.network) | {"filters": 512})
    assert command.training.augmented_fraction == 0 and command.training.epochs == recipe.settings.epochs


def test_train_defaults_follow_the_task_of_the_set(tmp_path):
    folder = tmp_path / "train"
    folder.mkdir()
    (folder / "meta.json").write_text(json.dumps({"configuration": {"task": "edge"}}))
    (folder / "pins.npz").touch()
    command = Train.parse(["--data", str(tmp_path), "--out", "none"], "tactip train")
    assert command.training == RECIPES["laptop"]["edge"].settings
    (folder / "pins.npz").unlink()
    command = Train.parse(["--data", str(tmp_path), "--out", "none"], "tactip train")
    assert command.training.augmented_fraction == 0  # without pins, images cannot be rendered again


@pytest.mark.parametrize(
    ("configuration", "downsample"),
    [
        ({"design": {"image": {"size_px": 256}}}, 4),
        ({"layout": {"size_px": 256}}, 4),
        ({"design": {"image": {"size_px": 128}}}, 2),
        ({"design": "damaged"}, 2),
        ({"layout": {"size_px": "damaged"}}, 2),
    ],
)
def test_train_default_network_takes_as_long_on_wide_images(configuration, downsample, tmp_path):
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "meta.json").write_text(json.dumps({"configuration": {"task": "edge"} | configuration}))
    command = Train.parse(["--data", str(tmp_path), "--out", "none"], "tactip train")
    assert command.network.downsample == downsample


def test_train_defaults_are_those_of_a_file_or_of_the_initial_network(tmp_path):
    file = tmp_path / "best.json"
    file.write_text(json.dumps({"network": {"filters": 4}, "settings": {"epochs": 3}}))
    command = train("--config", str(file), "--training.patience", "7")
    assert (command.network.filters, command.training.epochs, command.training.patience) == (4, 3, 7)
    shipped = read_recipe(tactip_models() / "surface-tactip-127" / "model.json").network
    assert train("--init-from", "surface-tactip-127").network == shipped


def tactip_models():
    from tactip_twin.assets import MODELS

    return MODELS


def test_tune_space_has_one_limit_of_filters_under_two_names():
    for option in ("--max-filters", "--space.max-filters"):
        command = Tune.parse(["--data", "a", "--out", "b", option, "64", "--trials", "7"], "tactip tune")
        assert command.settings.space == SearchSpace(max_filters=64)
        assert command.settings.trials == 7


def test_dataset_make_defaults_are_the_papers_for_each_task(tmp_path):
    surface, edge = sets_of(tmp_path, "--task", "all")
    assert [surface.task, edge.task] == ["surface", "edge"]
    assert repr(surface.pose) == repr(POSE_RANGES["surface"]) and repr(edge.pose) == repr(POSE_RANGES["edge"])
    assert repr(surface.shear) == repr(edge.shear) == repr(SHEAR_RANGES)  # as JSON too: the digest stays


def test_dataset_make_range_wins_for_each_task(tmp_path):
    for configuration in sets_of(tmp_path, "--task", "all", "--pose.yaw-deg", "0", "0", "--shear.x-mm", "-1", "1"):
        assert configuration.pose == Ranges(**asdict(POSE_RANGES[configuration.task]) | {"yaw_deg": (0.0, 0.0)})
        assert configuration.shear.x_mm == (-1.0, 1.0)


def test_import_explicit_option_wins_over_the_layout_file(tmp_path):
    file = tmp_path / "layout.json"
    file.write_text(json.dumps({"size_px": 64, "task": "edge", "dark_pins": True}))
    options = ["lab", "--out", "set", "--layout", str(file)]
    command = Import.parse(options, "tactip import")
    assert (command.preprocessing.size_px, command.column_map.task, command.preprocessing.dark_pins) == (64, "edge", True)
    command = Import.parse([*options, "--size-px", "128", "--task", "surface", "--no-dark-pins"], "tactip import")
    assert (command.preprocessing.size_px, command.column_map.task, command.preprocessing.dark_pins) == (
        128,
        "surface",
        False,
    )


@pytest.mark.parametrize("option", ["--task", "--columns", "--image-column", "--video-frame", "--angles"])
def test_camera_option_of_a_table_is_refused(capsys, option):
    status, error = refusal(capsys, "camera", "--images", "none", option, "x")
    assert status == 2 and option in error


@pytest.mark.parametrize("arguments", [[], ["brew"], ["dataset"], ["dataset", "brew"], ["bench", "error"]])
def test_unknown_command_exits_with_2(capsys, arguments):
    assert refusal(capsys, *arguments)[0] == 2


def test_view_choices_are_the_stimuli(capsys):
    status, error = refusal(capsys, "view", "--task", "cup")
    assert status == 2 and all(name in error for name in STIMULI)
    assert View().task in STIMULI


def test_view_of_no_object_refuses_its_options(capsys):
    assert tactip.main(["view", "--at-mm", "1", "2"]) == 1
    assert "--at-mm need an --object" in capsys.readouterr().err


def test_bench_without_benchmarks_says_how_to_get_them(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "tactip_twin.benchmarks.measurements", None)
    assert tactip.main(["bench", "fidelity"]) == 1
    error = capsys.readouterr().err
    assert "clone the repository" in error and len(error.splitlines()) == 1


def test_bench_runs_the_measurement_that_is_named(capsys, monkeypatch):
    from tactip_twin.benchmarks.scale import scale

    given = []
    monkeypatch.setattr(scale, "run", given.append)
    assert tactip.main(["bench", "scale", "--contacts", "7", "--out", "here"]) == 0
    assert given[0].contacts == 7
    assert capsys.readouterr().out == "here/scale.md written\n"


@pytest.mark.parametrize("command", [[], ["train"], ["servo"], ["dataset", "make"], ["tune"], ["camera"], ["bench"]])
def test_help_loads_nothing_heavy(command):
    code = (
        "import contextlib, io, sys\nfrom tactip_twin.commands.main import main\n"
        "with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):\n"
        f"    main([*{command!r}, '--help'])\n"
        "print([m for m in ('torch', 'mujoco', 'scipy', 'cv2', 'matplotlib') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout == "[]\n"


SHORT = {
    "servo": Servo,
    "camera": Camera,
    "import": Import,
    "train": Train,
    "tune": Tune,
    "transfer": Transfer,
    "dataset make": Make,
}


@pytest.mark.parametrize("name", SHORT)
def test_help_of_a_long_command_fits_a_screen_and_lists_the_common_options(monkeypatch, capsys, name):
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit):
        tactip.main([*name.split(), "--help"])
    short = capsys.readouterr().out
    with pytest.raises(SystemExit):
        tactip.main([*name.split(), "--help-all"])
    full = capsys.readouterr().out
    assert len(short.splitlines()) <= 50 and len(short) < 0.75 * len(full)
    listed = set(re.findall(r"^\W (?:-h, )?--([a-z][\w.-]*)", short, re.MULTILINE)) - {"help"}
    flat = ("options.", "column_map.", "preprocessing.", "settings.space.", *(() if name == "servo" else ("settings.",)))
    common = {re.sub(f"^({'|'.join(flat)})", "", option).replace("_", "-") for option in SHORT[name].common}
    assert {option.rpartition("space.")[2] for option in listed} == common - {"experiment", "source"}
    assert f"tactip {name} --help-all lists all" in short
    assert SHORT[name].example.split(" --")[0] in short


def test_help_with_an_unknown_common_option_raises():
    with pytest.raises(KeyError, match=r"route\.colour"):
        fields_named(Servo, ["out", "route.colour"])
