"""tactip track: follow a moving object by touch."""

from dataclasses import dataclass

from tactip_twin.commands._parsing import Command
from tactip_twin.commands._progress import DelayedStatus
from tactip_twin.control.track_options import TrackOptions


@dataclass(frozen=True)
class Track(TrackOptions, Command):
    """Follow a flat object that moves in all axes at once, by touch. Writes a recording, a score and a figure."""

    common = ("out", "object", "model", "fidelity", "arm", "seconds", "motion.amplitude_mm", "motion.amplitude_deg")
    example = "tactip track --fidelity fast --out runs/track"

    def run(self) -> int:
        import sys

        from tqdm import tqdm

        waiting = DelayedStatus("loading the object, the network and the arm")
        with tqdm(unit="step", file=sys.stderr, mininterval=0.5 if sys.stderr.isatty() else 15, delay=1) as bar:

            def progress(done: int, count: int) -> None:
                bar.total = count
                bar.update()

            with waiting:
                from tactip_twin.control.tracking import FIGURE, SCORE, track

            score = track(self, progress)
        print(f"error relative to the object, root mean square: {score['rms_mm']:.2f} mm, {score['rms_deg']:.2f}°")
        print(f"largest: {score['max_mm']:.2f} mm, {score['max_deg']:.2f}°; {score['stopped_because']}")
        print(f"{self.out / SCORE} and {self.out / FIGURE} written; tactip replay {self.out} shows the run")
        return 0 if score["stopped_because"] == "completed" else 1
