"""Rates that decide what a large data set costs."""

import json

import pytest

from tactip_twin.benchmarks.scale.options import ScaleOptions
from tactip_twin.benchmarks.scale.scale import run
from tactip_twin.tactip_model.errors import TactipError


@pytest.mark.slow
def test_run_measures_rates_and_writes_them(tmp_path):
    options = ScaleOptions(contacts=2, warm_up_contacts=1, messages=40, out=tmp_path)
    record = run(options, lambda line: None)
    assert json.loads((tmp_path / "scale.json").read_text()) == record
    for task, each in (("surface", 8), ("edge", 2)):
        figures = record["tasks"][task]
        assert figures["samples_a_contact"] == each
        assert 0 < figures["image_bytes"] < figures["bytes_a_sample"] < 50e3
        assert 0 < figures["note_s_a_sample"] < figures["close_s_a_sample"] < 0.5
    assert record["dispatch"]["processes of this machine"] > 1
    assert "disk space per sample" in (tmp_path / "scale.md").read_text()


@pytest.mark.parametrize(("name", "given", "least"), [("messages", 9, 10), ("contacts", 0, 1), ("warm_up_contacts", 0, 1)])
def test_too_few_are_refused(tmp_path, name, given, least):
    with pytest.raises(TactipError, match=f"--{name.replace('_', '-')} must be at least {least}, got {given}"):
        run(ScaleOptions(**{name: given}, out=tmp_path))
    assert not list(tmp_path.iterdir())
