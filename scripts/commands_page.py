"""The reference of commands, written from what each says of itself: python scripts/commands_page.py docs/commands.md"""

import contextlib
import io
import os
import re
import sys
from pathlib import Path

from tactip_twin.commands import main as tactip

_WIDE = "100"
"""Columns of the terminal that help is written for: wider, and its boxes stand side by side."""

_ENTRY = re.compile(r"(?P<name>(-|[A-Z]).*?)(\s{2,}(?P<rest>\S.*))?$")
_ENDS = re.compile(r"\s*\((default: (?P<default>.*)|(?P<required>required)|(?P<repeat>repeatable))\)$")


def help_of(words):
    """What a command (list of str) says of itself: (str)."""
    said = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")  # boxes are drawn in lines, as on a terminal
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        tactip.main([*words, "--help"])
    said.flush()
    return re.sub(r"\x1b\[[0-9;]*m", "", said.buffer.getvalue().decode())


def shard_dirs(text):
    """What a help text says: description (str), subcommands (list of str), and groups (dict of title to entries): lists of
    name and words (str)."""
    description, subcommands, groups, group = [], [], {}, None
    for line in text.splitlines():
        if line.startswith("╭─"):
            group = line.strip("╭─╮ ")
            groups[group] = []
        elif line.startswith("╰"):
            group = None
        elif group is None:
            description.append(line)
        else:
            told = line.strip("│").rstrip()
            if group == "subcommands":
                if named := re.match(r"\s*• (\S+)", told):
                    subcommands.append(named[1])
            elif set(told.strip()) == {"─"}:
                groups[group].clear()  # what was before is of the group, not of an option
            elif not told.startswith(" " * 3) and (entry := _ENTRY.match(told.strip())):
                groups[group].append([entry["name"], entry["rest"] or ""])
            elif groups[group]:
                groups[group][-1][1] += " " + told.strip()
    groups.pop("subcommands", None)
    words = " ".join(line for line in description if not line.startswith("usage:")).split()
    return " ".join(words), subcommands, groups


def _cell(text):
    return text.replace("|", "\\|").strip()


def lines_of(words):
    """Lines (list of str) of the page, on a command (list of str) and those under it."""
    about, subcommands, groups = shard_dirs(help_of(words))
    lines = ["", f"{'#' * min(len(words) + 1, 4)} tactip {' '.join(words)}", "", about] if words else []
    rows = []
    for entries in groups.values():
        for name, told in entries:
            if name.startswith("-h,"):
                continue
            end = _ENDS.search(told)
            default = "" if end is None else end["default"] or end["required"] or ""
            shown = "" if not default else "*required*" if default == "required" else f"`{default}`"
            rows.append(f"| `{_cell(name)}` | {_cell(shown)} | {_cell(_ENDS.sub('', told))} |")
    if rows:
        lines += ["", "| option | default | |", "|---|---|---|", *rows]
    for name in subcommands:
        lines += lines_of([*words, name])
    return lines


def page():
    """The page (str)."""
    os.environ["COLUMNS"] = _WIDE
    lines = [
        "# Commands",
        "",
        "Written by `make reference` from what each command says of itself; do not edit. `--help` after any of them tells",
        "the same. Results go to the standard output, what is told on the way to the standard error. The exit status is 0",
        "if the work was done, 1 if it was refused or failed (a sentence says why), 2 for options that there are not, and",
        "130 after Ctrl-C and 143 after SIGTERM: then the same command goes on from there, but for a servo run, which keeps",
        "what it recorded and wants another folder. Pages and cameras are ended by Ctrl-C, with 0.",
        *lines_of([]),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(page())
