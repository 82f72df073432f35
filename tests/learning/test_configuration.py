"""Configurations: light imports, choices and bounds."""

import subprocess
import sys
from typing import get_args

import pytest

from tactip_twin.learning.configuration import (
    RECIPES,
    Activation,
    OpticsName,
    RecipeName,
    ScheduleName,
    SearchSpace,
    TrainSettings,
    TuneSettings,
)
from tactip_twin.learning.optics_ranges import OPTICS
from tactip_twin.learning.posenet import ACTIVATIONS
from tactip_twin.learning.training import SCHEDULES
from tactip_twin.tactip_model.errors import TactipError


def test_configuration_imports_nothing_heavy():
    code = "import sys, tactip_twin.learning.configuration; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    assert "tactip_twin.learning.configuration" in loaded
    assert not {"torch", "scipy", "mujoco", "cv2", "hyperopt", "matplotlib"} & set(loaded)


@pytest.mark.parametrize(
    ("choices", "table"),
    [(Activation, ACTIVATIONS), (OpticsName, OPTICS), (ScheduleName, SCHEDULES), (RecipeName, RECIPES)],
)
def test_choices_match_table_names(choices, table):
    assert get_args(choices) == tuple(table)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TrainSettings(schedule="linear"), "unknown schedule 'linear': choose one of paper, cosine"),
        (
            lambda: TrainSettings(optics_ranges="bright"),
            "unknown optics_ranges 'bright': choose one of lens, lens-jitter, lens-salt, real, rim, steady, lens-clean",
        ),
        (lambda: TrainSettings(precision="half"), "unknown precision 'half': choose one of auto, float32, bfloat16"),
        (lambda: SearchSpace(max_filters=1), "max_filters must be a whole number from 2 to 1024, got 1"),
        (lambda: TuneSettings(trials=0), "trials must be a whole number from 1 to 100000, got 0"),
    ],
)
def test_settings_invalid_value_raises(make, message):
    with pytest.raises(TactipError, match=message):
        make()
