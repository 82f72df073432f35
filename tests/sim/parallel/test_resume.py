"""Output folders that may be resumed, and the messages that refuse others."""

import pytest

from tactip_twin.sim.parallel.resume import check_resumable, first_difference
from tactip_twin.tactip_model.errors import TactipError

SETTINGS = {"seed": 0, "network": {"units": [64, 32], "dropout": 0.1}}


def refusal(folder, recorded, requested, own=()):
    with pytest.raises(TactipError) as error:
        check_resumable(folder, "training", recorded, requested, own)
    return str(error.value)


@pytest.mark.parametrize("existing", [False, True])
def test_check_resumable_missing_or_empty_folder_is_new(tmp_path, existing):
    folder = tmp_path / "out"
    if existing:
        folder.mkdir()
    assert check_resumable(folder, "training", None, SETTINGS) is False
    assert folder.exists() == existing


def test_check_resumable_same_settings_can_be_resumed(tmp_path):
    (tmp_path / "model.json").write_text("{}")
    assert check_resumable(tmp_path, "training", {**SETTINGS}, SETTINGS) is True


@pytest.mark.parametrize("recorded", [{}, [], 0, ""])
def test_check_resumable_empty_settings_are_settings(tmp_path, recorded):
    """A folder with work without any settings is not empty."""
    (tmp_path / "file").write_text("")
    assert check_resumable(tmp_path, "training", recorded, recorded) is True


def test_check_resumable_foreign_content_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    output = refusal(tmp_path, None, SETTINGS)
    assert output == f"the folder {tmp_path} is not empty and holds no training: choose another folder"


def test_check_resumable_own_files_are_not_content(tmp_path):
    (tmp_path / ".lock").write_text("")
    assert check_resumable(tmp_path, "training", None, SETTINGS, own=(".lock",)) is False
    assert "not empty" in refusal(tmp_path, None, SETTINGS)
    (tmp_path / "thesis.tex").write_text("years of work")
    assert "not empty" in refusal(tmp_path, None, SETTINGS, own=(".lock",))


def test_check_resumable_other_settings_are_refused_by_the_first_difference(tmp_path):
    output = refusal(tmp_path, SETTINGS, {"seed": 1, "network": {"units": [64], "dropout": 0.1}})
    assert output == (
        f"the folder {tmp_path} holds a training with other settings (network.units is [64, 32] there, [64] here): "
        "choose another folder, or remove this one"
    )


@pytest.mark.parametrize(
    ("recorded", "requested", "expected"),
    [
        ({"b": 1, "a": 2}, {"b": 3, "a": 4}, ("a", "2", "4")),
        ({"a": {"b": {"c": 1}}}, {"a": {"b": {"c": 2}}}, ("a.b.c", "1", "2")),
        ({"a": 1}, {}, ("a", "1", "null")),
        ({}, {"a": {"b": 1}}, ("a", "null", '{"b": 1}')),
        ({"a": {"b": 1}}, {"a": 1}, ("a", '{"b": 1}', "1")),
        ({"a": "x"}, {"a": "y"}, ("a", '"x"', '"y"')),
        ([1], [1, 2], ("", "[1]", "[1, 2]")),
    ],
)
def test_first_difference_unequal_values_are_named(recorded, requested, expected):
    assert first_difference(recorded, requested) == expected


@pytest.mark.parametrize("value", [{}, {"a": {"b": [1, 2.5, None, "x"]}}, [1], None, 0.5])
def test_first_difference_equal_values_have_none(value):
    assert first_difference(value, value) is None


def test_first_difference_missing_key_equals_null():
    assert first_difference({"a": None}, {}) is None


def test_leftovers_of_a_kill_do_not_count(tmp_path):
    """A command that was killed during its first write is followed by the same one."""
    (tmp_path / ".model.pt.4194305.tmp").touch()
    assert not check_resumable(tmp_path, "training", None, {})
    (tmp_path / "model.pt").touch()
    with pytest.raises(TactipError, match="is not empty"):
        check_resumable(tmp_path, "training", None, {})
