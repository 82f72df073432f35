"""Tables between the markers of a page."""

import pytest

from tactip_twin.benchmarks.report import fill
from tactip_twin.tactip_model.errors import TactipError

PAGE = "# Speed\n\nProse.\n\n<!-- begin speed -->\nold\n<!-- end speed -->\n\nMore.\n"


def test_fill_replaces_the_table_and_keeps_the_prose():
    page = fill(PAGE, {"speed": "| a |\n|---|\n| 1 |\n"})
    assert page == PAGE.replace("old\n", "\n| a |\n|---|\n| 1 |\n\n")
    assert fill(page, {"speed": "| a |\n|---|\n| 1 |\n"}) == page


@pytest.mark.parametrize("tables", [{}, {"time": "x"}, {"speed": "x", "time": "y"}])
def test_fill_with_other_names_is_refused(tables):
    with pytest.raises(TactipError, match=r"tables of the page must be \[.*\], got \['speed'\]"):
        fill(PAGE, tables)
