"""Write the command reference from the commands' help texts: python scripts/commands_page.py docs/commands.md"""

import contextlib
import io
import os
import re
import sys
from pathlib import Path

from tactip_twin.commands import main as tactip

_WIDE = "100"
"""Terminal columns for the help texts; in a wider terminal the boxes stand side by side."""

_ENTRY = re.compile(r"(?P<name>[-A-Z{[].*?)(\s{2,}(?P<rest>\S.*))?$")
_ENDS = re.compile(r"\s*\((default: (?P<default>.*)|(?P<required>required)|(?P<repeat>repeatable))\)$")


def help_text(words: list[str]) -> str:
    """Return the help text of a command, given as the words after `tactip`."""
    stream = io.BytesIO()
    output = io.TextIOWrapper(stream, encoding="utf-8")  # with utf-8, boxes have lines as on a terminal
    with contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
        tactip.main([*words, "--help-all"])
    output.flush()
    return re.sub(r"\x1b\[[0-9;]*m", "", stream.getvalue().decode())


def parse_help(text: str) -> tuple[str, list[str], dict[str, list[list[str]]]]:
    """Parse a help text.

    Returns:
        The description, the names of subcommands, and the options by group, each as a list of its name and its help.
    """
    description: list[str] = []
    subcommands: list[str] = []
    groups: dict[str, list[list[str]]] = {}
    group: str | None = None
    for line in text.splitlines():
        if line.startswith("╭─"):
            group = line.strip("╭─╮ ")
            groups[group] = []
        elif line.startswith("╰"):
            group = None
        elif group is None:
            description.append(line)
        else:
            content = line.strip("│").rstrip()
            if group == "subcommands":
                if named := re.match(r"\s*• (\S+)", content):
                    subcommands.append(named[1])
            elif set(content.strip()) == {"─"}:
                groups[group].clear()  # the lines above describe the group, not an option
            elif not content.startswith(" " * 3) and (entry := _ENTRY.match(content.strip())):
                groups[group].append([entry["name"], entry["rest"] or ""])
            elif groups[group]:
                entry, text = groups[group][-1], content.strip()
                while text and entry[0].count("{") > entry[0].count("}"):  # the choices go on in this line
                    more, end, text = text.partition("}")
                    entry[0] += more + end
                entry[1] += " " + text
    groups.pop("subcommands", None)
    words = " ".join(line for line in description if not line.startswith("usage:")).split()
    return " ".join(words), subcommands, groups


def _cell(text: str) -> str:
    """Return text escaped for a cell of a Markdown table."""
    return text.replace("|", "\\|").strip()


def command_lines(words: list[str]) -> list[str]:
    """Return the lines of the page about a command and its subcommands."""
    about, subcommands, groups = parse_help(help_text(words))
    lines = ["", f"{'#' * min(len(words) + 1, 4)} tactip {' '.join(words)}", "", about] if words else []
    rows = []
    for entries in groups.values():
        for name, help_line in entries:
            if name.startswith("-h,"):
                continue
            end = _ENDS.search(help_line)
            default = "" if end is None else end["default"] or end["required"] or ""
            shown = "" if not default else "*required*" if default == "required" else f"`{default}`"
            rows.append(f"| `{_cell(name)}` | {_cell(shown)} | {_cell(_ENDS.sub('', help_line))} |")
    if rows:
        lines += ["", "| option | default | |", "|---|---|---|", *rows]
    for name in subcommands:
        lines += command_lines([*words, name])
    return lines


def markdown_page() -> str:
    """Return the reference as Markdown."""
    os.environ["COLUMNS"] = _WIDE
    lines = [
        "# Commands",
        "",
        "Written by `make reference` from the commands' help texts; do not edit. `--help` shows the common options of a",
        "command, `--help-all` all of them. Results are written to stdout, progress to stderr. Exit status: 0 after",
        "success, 1 after a refusal or a failure (one sentence says why), 2 for unknown options, 130 after Ctrl-C and",
        "143 after SIGTERM. The same command then resumes the work, except for servo runs and tracking, which keep their",
        "results and need another folder. Ctrl-C ends pages and cameras with status 0.",
        *command_lines([]),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(markdown_page())
