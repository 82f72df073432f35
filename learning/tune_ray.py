"""The search of tune.py on a cluster, with HyperOptSearch of Ray Tune: same space, trainings and files.

Needs the extra `cluster`. Every machine must see the data and the folder of the search under the same path, for example on a
shared disk. An interrupted search resumes from its results file.
"""

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from hyperopt.base import Domain
from tqdm import tqdm

from tactip_twin.learning.configuration import DeviceName, TuneSettings
from tactip_twin.learning.search_space import expressions
from tactip_twin.learning.tune import (
    LOCK,
    Result,
    interrupted_message,
    prepare_folder,
    read_result,
    record_start,
    resumed_results,
    run_trial,
    to_hyperopt_trials,
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
    data: str | Path, folder: str | Path, settings: TuneSettings, jobs: int, address: str, device: DeviceName = "auto"
) -> list[Result]:
    """Search on a Ray cluster, or resume an interrupted search; return the results.

    Args:
        data: Folder of a task's sets, shared by all machines.
        folder: Output folder, shared by all machines.
        settings: Settings of the search.
        jobs: Number of parallel trials.
        address: Address of the cluster; `auto` for that of this machine, `local` to start one on this machine.
        device: Device to train on.

    Raises:
        TactipError: If Ray is missing or cannot be reached, the data are invalid, or the folder holds something else.
        Interrupted: On Ctrl-C.
    """
    data, folder = Path(data).resolve(), Path(folder).resolve()
    ray_here()
    prepare_folder(folder, data, settings)
    with locked(folder / LOCK, f"searching in {folder}"):
        results = resumed_results(folder, settings)
        if len(results) >= settings.trials:
            plot_search(results, folder / "tune.png", settings.random_trials)
            return results
        clear(folder, results)
        with joined(address) as ray:
            return _tune(ray, data, folder, settings, jobs, device, results)


def clear(folder: Path, results: Sequence[Result]) -> None:
    """Remove the files of interrupted trials, because the search reuses their numbers.

    Args:
        folder: Folder of the search.
        results: Results of the trials that have ended.
    """
    ended = {r["trial"] for r in results}
    for record in (folder / "trials").glob("*.json"):
        if int(record.stem) not in ended:
            shutil.rmtree(record.with_suffix(""), ignore_errors=True)
            record.unlink()


def _tune(
    ray: ModuleType, data: Path, folder: Path, settings: TuneSettings, jobs: int, device: DeviceName, results: list[Result]
) -> list[Result]:
    """Search in a locked folder; see `tune_on_cluster`. ray: module, connected to a cluster. results: results so far."""
    from ray import tune as ray_tune  # pyright: ignore[reportMissingImports]

    left = settings.trials - len(results)

    def trial(point: dict[str, Any]) -> None:
        """Train one trial on any machine of the cluster."""
        record_start(folder, point["trial"], {"trial": point["trial"], "values": point["values"]})
        run_trial(str(data), str(folder), point["trial"], settings, device, threads=_CORES)
        result = read_result(folder, point["trial"], settings.space, "the trial wrote no result")
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
            raise Interrupted(interrupted_message(results, settings)) from None
    if len(results) < settings.trials:  # Ray handles Ctrl-C itself and then returns
        raise Interrupted(interrupted_message(results, settings))
    plot_search(results, folder / "tune.png", settings.random_trials)
    return results


def _search(settings: TuneSettings, results: Sequence[Result]) -> Any:
    """Return Ray Tune's HyperOptSearch with the results so far; it suggests the number and hyperopt's values of a trial."""
    from ray.tune.search.hyperopt import HyperOptSearch  # pyright: ignore[reportMissingImports]

    class Search(HyperOptSearch):
        """Search algorithm that suggests a trial's number and values instead of a point of the space."""

        def __init__(self) -> None:
            space = expressions(settings.space)
            super().__init__(
                space=space,
                metric="loss",
                mode="min",
                n_initial_points=max(1, settings.random_trials),  # includes the trials so far
                random_state_seed=settings.seed + len(results),
            )
            self._hpopt_trials = to_hyperopt_trials(results, Domain(lambda point: 0.0, space))
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
    """Return a callback for Ray Tune that writes the result of each trial when it ends."""
    from ray.tune import Callback  # pyright: ignore[reportMissingImports]

    class ResultWriter(Callback):
        """Callback that writes results."""

        def _write(self, trial: Any, why: str) -> None:
            """Write the result of a trial. why: reason of its failure, for a trial that wrote no result."""
            results.append(read_result(folder, trial.config["trial"], settings.space, why))
            write_results(folder, results, settings)
            bar.update()

        def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
            """Write the result of a trial that has returned."""
            self._write(trial, "the trial wrote no result")

        def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
            """Write the result of a trial that has failed."""
            self._write(trial, "the process ended without a result; the machine may be out of memory")

    return ResultWriter()
