"""tactip bench: measurements."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from tactip_twin.benchmarks.options import (
    FidelityOptions,
    LearningOptions,
    PerformanceOptions,
    ScaleOptions,
    SceneCostOptions,
    SearchOptions,
    ServoOptions,
    StabilityOptions,
    TransferOptions,
    ViewerOptions,
)


def _measured(options, run, page):
    """Run a measurement with its options, and say where its page (str) is. Returns its result (dict)."""
    result = run(options)
    print(f"{options.out / page} written")
    return result


class Stability(StabilityOptions):
    __doc__ = StabilityOptions.__doc__

    def run(self):
        from tactip_twin.benchmarks.physics.stability import run

        result = _measured(self, run, "stability.md")
        return 1 if result["counts"]["wrong"] else 0


class Error(FidelityOptions):
    __doc__ = FidelityOptions.__doc__

    def run(self):
        from tactip_twin.benchmarks.physics.fidelity import run

        _measured(self, run, "fidelity.md")
        return 0


class Parts(SceneCostOptions):
    __doc__ = SceneCostOptions.__doc__

    def run(self):
        from tactip_twin.benchmarks.physics.scene_cost import run

        _measured(self, run, "scene_cost.md")
        return 0


class Learning(LearningOptions):
    __doc__ = LearningOptions.__doc__

    def run(self):
        from tactip_twin.benchmarks.learning.learning import run

        _measured(self, run, "learning.md")
        return 0


class Search(SearchOptions):
    __doc__ = SearchOptions.__doc__

    def run(self):
        from tactip_twin.benchmarks.learning.search import run

        _measured(self, run, "search.md")
        return 0


class Followed(ServoOptions):
    __doc__ = ServoOptions.__doc__

    def run(self):
        from tactip_twin.benchmarks.servo.servo import run

        _measured(self, run, "servo.md")
        return 0


class Transferred(TransferOptions):
    __doc__ = TransferOptions.__doc__

    def run(self):
        from tactip_twin.benchmarks.learning.transfer import run

        _measured(self, run, "transfer.md")
        return 0


class Speed(PerformanceOptions):
    __doc__ = PerformanceOptions.__doc__

    def run(self):
        from tactip_twin.benchmarks.scale.performance import run

        _measured(self, run, "performance.md")
        return 0


class Scaled(ScaleOptions):
    __doc__ = ScaleOptions.__doc__

    def run(self):
        from tactip_twin.benchmarks.scale.scale import run

        _measured(self, run, "scale.md")
        return 0


class Viewed(ViewerOptions):
    __doc__ = ViewerOptions.__doc__

    def run(self):
        from tactip_twin.benchmarks.servo.viewer import run

        _measured(self, run, "viewer.md")
        return 0


@dataclass(frozen=True)
class Bench:
    """Measure the simulation and what is learned: errors, costs, and where they can be trusted."""

    action: Annotated[
        Annotated[Stability, tyro.conf.subcommand("stability")]
        | Annotated[Error, tyro.conf.subcommand("fidelity")]
        | Annotated[Parts, tyro.conf.subcommand("scene-cost")]
        | Annotated[Learning, tyro.conf.subcommand("learning")]
        | Annotated[Search, tyro.conf.subcommand("search")]
        | Annotated[Followed, tyro.conf.subcommand("servo")]
        | Annotated[Transferred, tyro.conf.subcommand("transfer")]
        | Annotated[Speed, tyro.conf.subcommand("performance")]
        | Annotated[Scaled, tyro.conf.subcommand("scale")]
        | Annotated[Viewed, tyro.conf.subcommand("viewer")],
        tyro.conf.arg(name=""),
    ]
    """What is measured."""

    def run(self):
        return self.action.run()
