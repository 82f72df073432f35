"""The front door: one subcommand for each job (commands/), and how each ends."""

import sys

import tyro

from commands.bench import Bench
from commands.help import flowing
from commands.learn import Evaluate, Train, Tune
from commands.look import Replay, View
from commands.real import Camera, Import, Transfer
from commands.sensor import Calibrate
from commands.servo import Servo
from commands.sets import Dataset
from tactip_model.errors import Stopped, TactipError


def main(arguments=None):
    """Run the command line. arguments: list of str, the process's own if None. Returns the exit status (int)."""
    about = "A digital twin of the TacTip, a soft optical fingertip."
    try:
        with flowing():
            command = tyro.extras.subcommand_cli_from_dict(
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
                description=about,
            )
        return command.run()
    except TactipError as error:
        print(f"tactip: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"tactip: {error.filename or 'a file'}: {error.strerror or error}", file=sys.stderr)
        return 1
    except (Stopped, KeyboardInterrupt) as stopped:
        print(f"tactip: stopped; {stopped or 'nothing was begun'}", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
