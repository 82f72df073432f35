"""The search of tune.py on a cluster, by Ray Tune's HyperOptSearch: the same space, trainings and files.

Needs the extra `cluster`. The data and the folder of the search must be visible to every machine under the same path, as on
a shared disk. A search that was stopped goes on from its results file.
"""

import shutil
import sys
from pathlib import Path

from hyperopt.base import Domain
from tqdm import tqdm

from tactip_twin.learning.search_space import expressions
from tactip_twin.learning.tune import (
    LOCK,
    claim,
    draw,
    note,
    past,
    read_results,
    result_of,
    run_trial,
    values_of,
    write_results,
)
from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.sim.parallel.ray_pool import joined, ray_here
from tactip_twin.tactip_model.errors import Interrupted, TactipError

_CORES = 1
"""Cores of a trial."""


def tune_on_cluster(data, folder, settings, jobs, address, device="auto"):
    """Search on the Ray cluster at `address` (str; auto: that of this machine; local: one of this machine alone).

    data, folder: paths that all machines share. settings: tune.TuneSettings. jobs: int, trials at a time. device: str.
    Returns the results (list of dict). Raises TactipError where Ray is missing, cannot be reached, or data and folder do not
    do, and Interrupted at Ctrl-C.
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


def clear(folder, results):
    """Remove what is left of trials that were stopped: the search goes on with others, under their numbers as well.

    folder: Path. results: list of dict, of the trials that are over.
    """
    over = {r["trial"] for r in results}
    for noted in (folder / "trials").glob("*.json"):
        if int(noted.stem) not in over:
            shutil.rmtree(noted.with_suffix(""), ignore_errors=True)
            noted.unlink()


def _tune(ray, data, folder, settings, jobs, device, results):
    """`tune_on_cluster`, in a folder that is ours. ray: the module, joined. results: list of dict, so far."""
    from ray import tune as ray_tune  # pyright: ignore[reportMissingImports]

    left = settings.trials - len(results)

    def trial(point):
        """One trial, on whichever machine."""
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
                storage_path=str(folder / "ray"), verbose=0, callbacks=[_keeper(folder, results, settings, bar)]
            ),
        )
        try:
            tuner.fit()
        except KeyboardInterrupt:
            raise Interrupted(_over(results, settings)) from None
    if len(results) < settings.trials:  # Ray answers Ctrl-C itself, and then returns
        raise Interrupted(_over(results, settings))
    draw(results, folder / "tune.png", settings.startup)
    return results


def _over(results, settings):
    """What is said of a search that was stopped."""
    return f"{len(results)} of {settings.trials} trials are over: the same command goes on"


def _search(settings, results):
    """Ray Tune's HyperOptSearch, that knows the results so far, and gives a trial its number and hyperopt's own values."""
    from ray.tune.search.hyperopt import HyperOptSearch  # pyright: ignore[reportMissingImports]

    class Search(HyperOptSearch):
        """Suggests a trial's number and values instead of a point of the space."""

        def __init__(self):
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

        def suggest(self, trial_id):
            if super().suggest(trial_id) is None:
                return None
            values = values_of(self._live_trial_mapping[trial_id][1])
            self._next += 1
            return {"trial": self._next - 1, "values": values}

    return Search()


def _keeper(folder, results, settings, bar):
    """A callback of Ray Tune's that writes each trial's result as it ends."""
    from ray.tune import Callback  # pyright: ignore[reportMissingImports]

    class Keeper(Callback):
        """Keeps results."""

        def _keep(self, trial, why):
            results.append(result_of(folder, trial.config["trial"], why))
            write_results(folder, results, settings)
            bar.update()

        def on_trial_complete(self, iteration, trials, trial, **info):
            self._keep(trial, "it left no result")

        def on_trial_error(self, iteration, trials, trial, **info):
            self._keep(trial, "its process ended: is memory short?")

    return Keeper()
