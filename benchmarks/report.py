"""Pages in docs/: prose written by hand, with measured tables between markers."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file

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


def write_results(name: str, result: Mapping[str, Any], tables: Mapping[str, str], out: Path) -> None:
    """Write out/NAME.json, and out/NAME.md: the prose of docs/NAME.md with these tables. Raises as `fill` does."""
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / f"{name}.json", (json.dumps(result, indent=1) + "\n").encode())
    write_file(out / f"{name}.md", fill((DOCS / f"{name}.md").read_text(), tables).encode())


def read_results(path: Path) -> dict[str, Any]:
    """Return the results in a JSON file of an earlier measurement; empty if there is none."""
    return json.loads(path.read_text()) if path.exists() else {}
