"""The search of tune.py on a cluster, by Ray Tune's HyperOptSearch: the same space, trainings and files.

Needs the extra `cluster`. The data and the folder of the search must be visible to every machine under the same path, as on
a shared disk. An interrupted search resumes from its results file.
"""

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from hyperopt.base import Domain
from tqdm import tqdm

from tactip_twin.learning.configuration import TuneSettings
from tactip_twin.learning.search_space import expressions
from tactip_twin.learning.tune import (
    LOCK,
    Result,
    claim,
    note,
    past,
    read_results,
    result_of,
    run_trial,
    values_of,
    write_results,
)
from tactip_twin.learning.tune_figure import plot_search
from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.sim.parallel.ray_pool import joined, ray_here
from tactip_twin.tactip_model.errors import Interrupted, TactipError

_CORES = 1
"""Cores per trial."""


def tune_on_cluster(
    data: str | Path, folder: str | Path, settings: TuneSettings, jobs: int, address: str, device: str = "auto"
) -> list[Result]:
    """Search on a Ray cluster, or resume a search; return the results.

    Args:
        data: Folder of a task's sets, shared by all machines.
        folder: Output folder, shared by all machines.
        settings: Settings of the search.
        jobs: Number of trials at a time.
        address: Address of the cluster; `auto` for that of this machine, `local` for one of this machine alone.
        device: Device to train on.

    Raises:
        TactipError: Where Ray is missing or cannot be reached, the data cannot be used, or the folder holds something else.
        Interrupted: At Ctrl-C.
    """
    data, folder = Path(data).resolve(), Path(folder).resolve()
    ray_here()
    claim(folder, data, settings)
    with locked(folder / LOCK, f"searching in {folder}"):
        results = read_results(folder)
        if len(results) >= settings.trials:
            return results
        clear(folder, results)
        with joined(address) as ray:
            return _tune(ray, data, folder, settings, jobs, device, results)


def clear(folder: Path, results: Sequence[Result]) -> None:
    """Remove the files of interrupted trials, because the search reuses their numbers for others.

    Args:
        folder: Folder of the search.
        results: Results of the trials that have ended.
    """
    ended = {r["trial"] for r in results}
    for noted in (folder / "trials").glob("*.json"):
        if int(noted.stem) not in ended:
            shutil.rmtree(noted.with_suffix(""), ignore_errors=True)
            noted.unlink()


def _tune(
    ray: ModuleType, data: Path, folder: Path, settings: TuneSettings, jobs: int, device: str, results: list[Result]
) -> list[Result]:
    """Search in a locked folder; see `tune_on_cluster`. ray: the module, joined to a cluster. results: those so far."""
    from ray import tune as ray_tune  # pyright: ignore[reportMissingImports]

    left = settings.trials - len(results)

    def trial(point: dict[str, Any]) -> None:
        """Train one trial, on any machine of the cluster."""
        note(folder, point["trial"], {"trial": point["trial"], "values": point["values"]})
        run_trial(str(data), str(folder), point["trial"], settings, device, threads=_CORES)
        result = result_of(folder, point["trial"], "it left no result")
        if result["status"] != "ok":
            raise TactipError(result["why"])
        ray_tune.report({"loss": result["loss"]})

    resources = {"cpu": _CORES, "gpu": 1 if ray.cluster_resources().get("GPU") and device != "cpu" else 0}
    with tqdm(total=settings.trials, initial=len(results), unit="trial", file=sys.stderr) as bar:
        tuner = ray_tune.Tuner(
            ray_tune.with_resources(trial, resources),
            tune_config=ray_tune.TuneConfig(
                search_alg=_search(settings, results),
                num_samples=left,
                max_concurrent_trials=jobs,
                metric="loss",
                mode="min",
            ),
            run_config=ray_tune.RunConfig(
                storage_path=str(folder / "ray"), verbose=0, callbacks=[_result_writer(folder, results, settings, bar)]
            ),
        )
        try:
            tuner.fit()
        except KeyboardInterrupt:
            raise Interrupted(_interrupted(results, settings)) from None
    if len(results) < settings.trials:  # Ray answers Ctrl-C itself, and then returns
        raise Interrupted(_interrupted(results, settings))
    plot_search(results, folder / "tune.png", settings.startup)
    return results


def _interrupted(results: Sequence[Result], settings: TuneSettings) -> str:
    """Return the message of an interrupted search."""
    return f"{len(results)} of {settings.trials} trials are over: the same command goes on"


def _search(settings: TuneSettings, results: Sequence[Result]) -> Any:
    """Return Ray Tune's HyperOptSearch with the results so far, which gives a trial its number and hyperopt's own values."""
    from ray.tune.search.hyperopt import HyperOptSearch  # pyright: ignore[reportMissingImports]

    class Search(HyperOptSearch):
        """Suggests a trial's number and values instead of a point of the space."""

        def __init__(self) -> None:
            space = expressions(settings.space)
            super().__init__(
                space=space,
                metric="loss",
                mode="min",
                n_initial_points=max(1, settings.startup),  # the trials so far count among them
                random_state_seed=settings.seed + len(results),
            )
            self._hpopt_trials = past(results, Domain(lambda point: 0.0, space))
            self._next = 1 + max((r["trial"] for r in results), default=-1)

        def suggest(self, trial_id: str) -> dict[str, Any] | None:
            """Return the number and values of the next trial."""
            if super().suggest(trial_id) is None:
                return None
            values = values_of(self._live_trial_mapping[trial_id][1])
            self._next += 1
            return {"trial": self._next - 1, "values": values}

    return Search()


def _result_writer(folder: Path, results: list[Result], settings: TuneSettings, bar: tqdm) -> Any:
    """Return a callback of Ray Tune's that writes each trial's result as it ends."""
    from ray.tune import Callback  # pyright: ignore[reportMissingImports]

    class ResultWriter(Callback):
        """Writes results."""

        def _write(self, trial: Any, why: str) -> None:
            """Write the result of a trial. why: the reason where it left none."""
            results.append(result_of(folder, trial.config["trial"], why))
            write_results(folder, results, settings)
            bar.update()

        def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
            """Write the result of a trial that has returned."""
            self._write(trial, "it left no result")

        def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
            """Write the result of a trial that has failed."""
            self._write(trial, "its process ended: is memory short?")

    return ResultWriter()
