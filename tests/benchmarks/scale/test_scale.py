"""What many machines cost: the rates are measured, and the rest is arithmetic that can be done by hand."""

import json

import pytest

from tactip_twin.benchmarks.options import ScaleOptions
from tactip_twin.benchmarks.scale.scale import markdown, run
from tactip_twin.tactip_model.errors import TactipError

FIGURES = {
    "samples_a_contact": 8,
    "contact_s": 0.3592,
    "worker_mib": 145.0,
    "bytes_a_sample": 5000.0,
    "image_bytes": 1000.0,
    "close_s_a_sample": 1e-4,
    "note_s_a_sample": 1e-5,
    "verify_s_a_sample": 1e-4,
    "read_s_a_sample": 1e-4,
}


def test_what_is_reckoned_is_what_a_hand_reckons():
    dispatch = {"processes of this machine": 9000.0, "Ray": 8000.0, "Ray, one task a message": 1000.0}
    record = {"machine": {"cores": "2"}, "settings": "none", "tasks": {"surface": FIGURES}, "dispatch": dispatch}
    told = markdown(record)
    assert "8,000,000 samples, 40 GB in as many image files, 100 core hours." in told
    # A contact is 0.3592 s, its eight samples' part of the end of their shard 0.0008 s. 200 workers make 555.6 contacts a
    # second, of 9 files and 40 kB each, and 0.044 s of taking note.
    assert "| 100 | 0.5 | 556 | 22.2 | 5,000 | 200 | 4.4 % |" in told
    assert (
        "taking note of shards by 4,500 workers; handing out tasks by 2,880 workers; "
        "messages of a second's work by 1,000 workers" in told
    )
    assert "40 dollars; 800 shards" in told


def test_rates_are_measured(tmp_path):
    options = ScaleOptions(contacts=2, few=1, messages=40, out=tmp_path)
    record = run(options, lambda line: None)
    assert json.loads((tmp_path / "scale.json").read_text()) == record
    for task, each in (("surface", 8), ("edge", 2)):
        figures = record["tasks"][task]
        assert figures["samples_a_contact"] == each
        assert 0 < figures["image_bytes"] < figures["bytes_a_sample"] < 50e3
        assert 0 < figures["note_s_a_sample"] < figures["close_s_a_sample"] < 0.5
    assert record["dispatch"]["processes of this machine"] > 1
    assert "What an object store changes" in (tmp_path / "scale.md").read_text()


@pytest.mark.parametrize(("name", "given", "least"), [("messages", 9, 10), ("contacts", 0, 1), ("few", 0, 1)])
def test_too_few_are_refused(tmp_path, name, given, least):
    with pytest.raises(TactipError, match=f"--{name} must be at least {least}, got {given}"):
        run(ScaleOptions(**{name: given}, out=tmp_path))
    assert not list(tmp_path.iterdir())
