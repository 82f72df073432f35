"""The command line: one subcommand for each job, and how each ends."""

import contextlib
import signal
import sys
import threading
from importlib.metadata import version

from tactip_twin.tactip_model.errors import Interrupted, TactipError


def main(arguments=None):
    """Run the command line. arguments: list of str, the process's own if None. Returns the exit status (int)."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(version("tactip-twin"))
        return 0
    with _terminable() as signals:
        try:
            return _command(arguments).run()
        except TactipError as error:
            print(f"tactip: {error}", file=sys.stderr)
            return 1
        except OSError as error:
            print(f"tactip: {error.filename or 'a file'}: {error.strerror or error}", file=sys.stderr)
            return 1
        except (Interrupted, KeyboardInterrupt) as stopped:
            return _stopped(str(stopped), signals)
        except ImportError as error:
            # A library of compiled code that is stopped while it is loaded says that it cannot be.
            if not _is_from_stop(error):
                raise
            return _stopped("", signals)


def _stopped(what, signals):
    """Tell that the command was stopped, and `what` is kept (str). signals: list of those that came. Returns its status."""
    print("tactip: stopped" + (f"; {what}" if what else ""), file=sys.stderr)
    return 128 + (signals or [signal.SIGINT])[0]


def _is_from_stop(error):
    """Whether an exception came of a KeyboardInterrupt (bool)."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _command(arguments):
    """The command (an object of commands/) that is asked for."""
    # Here, and not above: what is stopped while it loads ends as what is stopped later does.
    import tyro

    from tactip_twin.commands._help_text import flowing
    from tactip_twin.commands.bench import Bench
    from tactip_twin.commands.calibrate import Calibrate
    from tactip_twin.commands.dataset import Dataset
    from tactip_twin.commands.servo import Servo
    from tactip_twin.commands.sim2real import Camera, Import, Transfer
    from tactip_twin.commands.train import Evaluate, Train, Tune
    from tactip_twin.commands.view import Replay, View

    with flowing():
        return tyro.extras.subcommand_cli_from_dict(
            {
                "dataset": Dataset,
                "import": Import,
                "calibrate": Calibrate,
                "train": Train,
                "tune": Tune,
                "evaluate": Evaluate,
                "transfer": Transfer,
                "camera": Camera,
                "servo": Servo,
                "replay": Replay,
                "view": View,
                "bench": Bench,
            },
            args=arguments,
            prog="tactip",
            description="A digital twin of the TacTip, a soft optical fingertip.",
        )


@contextlib.contextmanager
def _terminable():
    """For a `with` block in which SIGTERM, by which schedulers and services end what runs, is taken as Ctrl-C is. Yields the
    list of those that came."""
    came = []

    def take(number, _):
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
