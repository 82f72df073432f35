"""The command line: the list of commands, and their exit statuses."""

import contextlib
import ctypes
import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from importlib.metadata import version
from types import FrameType
from typing import TYPE_CHECKING

from tactip_twin.tactip_model.errors import Interrupted, TactipError

if TYPE_CHECKING:
    from tactip_twin.commands._parsing import Command

COMMANDS = {
    "dataset": ("dataset", "Dataset", "Make, verify, show, record and export data sets."),
    "protocol": ("protocol", "WriteProtocol", "Write the poses of a recording with a real sensor."),
    "import": ("import_set", "Import", "Import a data set of a real sensor."),
    "calibrate": ("calibrate", "Calibrate", "Fit the sensor to real frames."),
    "fast-tip": ("fast_tip", "FastTip", "Teach a tip that predicts contacts."),
    "sliding-tip": ("sliding_tip", "SlidingTip", "Teach a tip that predicts how the skin slides."),
    "train": ("train", "Train", "Train a network on a data set."),
    "tune": ("tune", "Tune", "Search for a network."),
    "evaluate": ("evaluate", "Evaluate", "Measure the errors of a network on a set."),
    "export": ("export", "Export", "Write a network for other software."),
    "transfer": ("transfer", "Transfer", "Train in simulation, test on a real sensor."),
    "camera": ("camera", "Camera", "Show a real sensor live."),
    "servo": ("servo", "Servo", "Follow a surface or an edge by touch."),
    "track": ("track", "Track", "Follow a moving object by touch."),
    "replay": ("replay", "Replay", "Show a recording in a browser, or write a video of it."),
    "view": ("view", "View", "Show the live scene in a browser."),
    "bench": ("bench", "Bench", "Measure errors, costs and limits."),
}
"""Module in this folder, class and summary of each command."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line, by default that of the process. Return the exit status."""
    _open_standard_streams()
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments == ["--version"]:
        print(version("tactip-twin"))
        return 0
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names may not be text; terminals may lack letters
    with _terminable() as signals:
        try:
            status = _command(arguments).run()
            sys.stdout.flush()
            return status
        except (Interrupted, KeyboardInterrupt) as stopped:
            return _stopped(str(stopped), signals)
        except ctypes.ArgumentError as error:
            # An interrupt while ctypes converts an argument, as libraries of OpenGL do while they load, is text alone.
            if "KeyboardInterrupt" not in str(error):
                raise
            return _stopped("", signals)
        except (TactipError, OSError, MemoryError, ImportError) as error:
            # A compiled library that is interrupted while it loads reports a failure to load.
            if isinstance(error, ImportError) and _is_from_stop(error):
                return _stopped("", signals)
            return _failed(error)


def _open_standard_streams() -> None:
    """Open the standard streams that the caller has closed, as some schedulers do, on the null device. Otherwise the next
    files that are opened would get their numbers, and messages of libraries would go into these files."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w", encoding="utf-8", closefd=False))  # noqa: SIM115 - for the whole process


_BROKEN_PIPE = 141
"""Exit status if the reader of the output has ended, by the shells' convention."""


def _failed(error: TactipError | OSError | MemoryError | ImportError) -> int:
    """Print one sentence about an error, and return the exit status. Raises the error if it is a defect of the program."""
    if isinstance(error, BrokenPipeError):
        # The reader, such as `| head -1`, has ended; results are kept. Without this, Python would complain at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _BROKEN_PIPE
    problem = str(error)
    if isinstance(error, MemoryError):
        problem = "this process is not allowed enough memory for this command"
    elif isinstance(error, ImportError):
        if not any(words in problem for words in ("failed to map segment", "annot allocate memory")):
            raise error
        problem = "this process is not allowed enough memory to load its libraries"
    elif isinstance(error, OSError):
        problem = f"{error.filename or 'the output or a file'}: {error.strerror or error}"
    print(f"tactip: {problem}", file=sys.stderr)
    return 1


def _stopped(what: str, signals: list[int]) -> int:
    """Print that the command was interrupted.

    Args:
        what: What is kept.
        signals: Signals that were received.

    Returns:
        The exit status.
    """
    print("tactip: stopped" + (f"; {what}" if what else ""), file=sys.stderr)
    return 128 + (signals or [signal.SIGINT])[0]


def _is_from_stop(error: BaseException | None) -> bool:
    """Return whether an exception was caused by a KeyboardInterrupt."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _command(arguments: Sequence[str]) -> "Command":
    """Return the command of a command line."""
    # Imported here, so an interrupt while these load is handled like a later one.
    from tactip_twin.commands._parsing import Command, Entry, parse_subcommand

    def parser(module: str, name: str) -> Callable[[Sequence[str], str], Command]:
        """Return the parser of a command, which loads the command's module when it is called."""

        def parse(arguments: Sequence[str], prog: str) -> Command:
            command: type[Command] = getattr(import_module(f"tactip_twin.commands.{module}"), name)
            return command.parse(arguments, prog)

        return parse

    table = {name: Entry(summary, parser(module, kind)) for name, (module, kind, summary) in COMMANDS.items()}
    return parse_subcommand(table, arguments, "tactip", "A digital twin of the TacTip, a soft optical fingertip.")


@contextlib.contextmanager
def _terminable() -> Iterator[list[int]]:
    """Handle SIGTERM, with which schedulers end programs, like Ctrl-C in a `with` block. Yield the signals
    received."""
    came: list[int] = []

    def take(number: int, _: FrameType | None) -> None:
        came.append(number)
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    before = signal.signal(signal.SIGTERM, take)
    try:
        yield came
    finally:
        signal.signal(signal.SIGTERM, before)


if __name__ == "__main__":
    sys.exit(main())
