"""The measurements: the table that `tactip bench` makes its subcommands from.

Their options are in the folders' `options.py`. Nothing heavy is imported, because the command line reads this module before
it knows which command runs.
"""

from typing import NamedTuple

from tactip_twin.benchmarks.learning.options import (
    AnyMaterialsOptions,
    ConventionsOptions,
    FastTipOptions,
    HiddenSensorsOptions,
    LearningOptions,
    MissingNeutralImageOptions,
    RealComparisonOptions,
    ReleaseModelsOptions,
    SearchOptions,
    SlidingTipOptions,
    TransferOptions,
    UncertaintyOptions,
)
from tactip_twin.benchmarks.physics.options import (
    FemCrossCheckOptions,
    FidelityOptions,
    FrictionOptions,
    MaterialsOptions,
    MechanicsOptions,
    MeshContactOptions,
    SceneCostOptions,
    StabilityOptions,
)
from tactip_twin.benchmarks.scale.options import (
    PerformanceOptions,
    ScaleOptions,
)
from tactip_twin.benchmarks.servo.options import (
    HardObjectsOptions,
    ReinforcementLearningOptions,
    ServoBenchOptions,
    TrackingOptions,
)


class Measurement(NamedTuple):
    """A subcommand of `tactip bench`."""

    module: str
    """Module whose `run(options)` measures and returns the results (dict)."""
    options: type
    """Dataclass of its options."""
    page: str
    """File that it writes into the folder `options.out`; empty if it writes no page."""


MEASUREMENTS = {
    "fidelity": Measurement("tactip_twin.benchmarks.physics.fidelity", FidelityOptions, "fidelity.md"),
    "stability": Measurement("tactip_twin.benchmarks.physics.stability", StabilityOptions, "stability.md"),
    "friction": Measurement("tactip_twin.benchmarks.physics.friction", FrictionOptions, "friction.md"),
    "materials": Measurement("tactip_twin.benchmarks.physics.materials", MaterialsOptions, "materials.md"),
    "mechanics": Measurement("tactip_twin.benchmarks.physics.mechanics", MechanicsOptions, "mechanics.md"),
    "fem-cross-check": Measurement(
        "tactip_twin.benchmarks.physics.fem_cross_check", FemCrossCheckOptions, "fem_cross_check.md"
    ),
    "mesh-contact": Measurement("tactip_twin.benchmarks.physics.mesh_contact", MeshContactOptions, "mesh_contact.md"),
    "scene-cost": Measurement("tactip_twin.benchmarks.physics.scene_cost", SceneCostOptions, "scene_cost.md"),
    "learning": Measurement("tactip_twin.benchmarks.learning.learning", LearningOptions, "learning.md"),
    "uncertainty": Measurement("tactip_twin.benchmarks.learning.uncertainty", UncertaintyOptions, "uncertainty.md"),
    "fast-tip": Measurement("tactip_twin.benchmarks.learning.fast_tip", FastTipOptions, "fast_tip.md"),
    "sliding-tip": Measurement("tactip_twin.benchmarks.learning.sliding_tip", SlidingTipOptions, "sliding_tip.md"),
    "any-materials": Measurement("tactip_twin.benchmarks.learning.any_materials", AnyMaterialsOptions, "any_materials.md"),
    "search": Measurement("tactip_twin.benchmarks.learning.search", SearchOptions, "search.md"),
    "transfer": Measurement("tactip_twin.benchmarks.learning.transfer", TransferOptions, "transfer.md"),
    "release-models": Measurement("tactip_twin.benchmarks.learning.release_models", ReleaseModelsOptions, ""),
    "missing-neutral-image": Measurement(
        "tactip_twin.benchmarks.learning.missing_neutral_image", MissingNeutralImageOptions, ""
    ),
    "conventions": Measurement("tactip_twin.benchmarks.learning.conventions", ConventionsOptions, "conventions.md"),
    "hidden-sensors": Measurement(
        "tactip_twin.benchmarks.learning.hidden_sensors", HiddenSensorsOptions, "hidden_sensors.md"
    ),
    "real-comparison": Measurement(
        "tactip_twin.benchmarks.learning.real_comparison", RealComparisonOptions, "real_and_simulated.png"
    ),
    "servo": Measurement("tactip_twin.benchmarks.servo.servo", ServoBenchOptions, "servo.md"),
    "hard-objects": Measurement("tactip_twin.benchmarks.servo.hard_objects", HardObjectsOptions, "hard_objects.md"),
    "tracking": Measurement("tactip_twin.benchmarks.servo.tracking", TrackingOptions, "tracking.md"),
    "reinforcement-learning": Measurement(
        "tactip_twin.benchmarks.servo.reinforcement_learning", ReinforcementLearningOptions, "reinforcement_learning.md"
    ),
    "performance": Measurement("tactip_twin.benchmarks.scale.performance", PerformanceOptions, "performance.md"),
    "scale": Measurement("tactip_twin.benchmarks.scale.scale", ScaleOptions, "scale.md"),
}
"""Measurements by the name of their command, which is also that of their module and page."""
