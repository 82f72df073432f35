"""Pages in docs/: prose written by hand, with measured tables between markers."""

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from tactip_twin.tactip_model.errors import TactipError

DOCS = Path(__file__).resolve().parents[1] / "docs"

_BLOCK = re.compile(r"(<!-- begin (?P<name>[\w-]+) -->\n).*?(<!-- end (?P=name) -->)", re.DOTALL)


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table of cells."""
    return "\n".join("| " + " | ".join(map(str, row)) + " |" for row in (head, ["---"] * len(head), *rows))


def fill(page: str, tables: Mapping[str, str]) -> str:
    """Return a page with the text between its markers replaced.

    Args:
        page: Markdown, with each table between `<!-- begin NAME -->` and `<!-- end NAME -->` on lines of their own.
        tables: Markdown by name.

    Raises:
        TactipError: The page's names are not those of the tables.
    """
    names = [found["name"] for found in _BLOCK.finditer(page)]
    if sorted(names) != sorted(tables):
        raise TactipError(f"tables of the page must be {sorted(tables)}, got {sorted(names)}")
    return _BLOCK.sub(lambda found: f"{found[1]}\n{tables[found['name']].strip()}\n\n{found[3]}", page)


def write_page(name: str, tables: Mapping[str, str], out: Path) -> None:
    """Write out/NAME.md: the prose of docs/NAME.md with these tables. Raises as `fill` does."""
    (out / f"{name}.md").write_text(fill((DOCS / f"{name}.md").read_text(), tables))
