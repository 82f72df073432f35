"""Sets made on a cluster equal those of one process, even when a machine is lost on the way."""

import sys
import threading
import time

import pytest

from helpers.set_commands import contents
from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.parallel.ray_pool import RayPool
from tactip_twin.tactip_model.errors import TactipError


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_make_on_two_machines_of_which_one_is_lost_equals_one_process(design, tmp_path):
    """Needs the extra `cluster`. The second machine is killed once both have begun to make samples."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    job = {
        "task": "surface", "split": "train", "samples": 24, "seed": 0, "renderer": "raster", "design": design,
        "fidelity": fidelity_named("draft"), "pose": POSE_RANGES["surface"], "shear": SHEAR_RANGES,
    }  # fmt: skip
    make([Job(Configuration(**job), tmp_path / "one")], 1, log=lambda line: None)
    machines = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    second = machines.add_node(num_cpus=1)
    lost, messages = threading.Event(), []

    def lose_it():
        records = tmp_path / "many" / ".partial"
        end = time.monotonic() + 120
        while len(list(records.glob("*.npz"))) < 4 and time.monotonic() < end:
            time.sleep(0.05)
        machines.remove_node(second, allow_graceful=False)
        lost.set()

    watch = threading.Thread(target=lose_it)
    watch.start()
    try:
        (made,) = make([Job(Configuration(**job), tmp_path / "many")], 0, messages.append, machines.address)
    finally:
        watch.join()
        machines.shutdown()
    assert lost.is_set()
    assert made["kept"] + made["failed"] == 24
    assert any("another worker takes over" in line for line in messages)
    assert contents(tmp_path / "many") == contents(tmp_path / "one")


class FakeRay:
    """A cluster in this process: an actor does its tasks when its reply is fetched; some actors die of some tasks."""

    class exceptions:
        class RayActorError(Exception):
            pass

    def __init__(self, places, deadly=()):
        self.places, self.deadly, self.alive, self.given = places, list(deadly), 0, []

    def cluster_resources(self):
        return {"CPU": float(self.places)}

    def remote(self, **options):
        assert options["num_cpus"] == 1 and options["runtime_env"]["env_vars"]["OMP_NUM_THREADS"] == "1"

        def wrap(kind):
            def actor(*arguments):
                self.alive += 1
                inner = kind(*arguments)
                method = type("Method", (), {"remote": staticmethod(lambda tasks: (inner, tasks))})
                return type("Actor", (), {"attempt": method})

            return type("Kind", (), {"remote": staticmethod(actor)})

        return wrap

    def wait(self, references, num_returns=1, timeout=None):
        return references[:num_returns], references[num_returns:]

    def get(self, reference):
        inner, tasks = reference
        self.given.append(tasks)
        for task in tasks:
            if task in self.deadly:
                self.deadly.remove(task)
                self.alive -= 1
                raise self.exceptions.RayActorError
        return inner.attempt(tasks)

    def kill(self, actor):
        self.alive -= 1


def _begin(done, wrong):
    def do(task):
        if task == wrong:
            raise TactipError("the disk is full")
        done.append(task)

    return do


def make_pool(ray, tasks, wrong=None):
    made, messages = [], []
    return RayPool(ray, _begin, (made, wrong), tasks, "sample", messages.append), made, messages


def test_ray_pool_does_every_task_once_and_leaves_no_worker():
    ray, reported = FakeRay(3), []
    pool, made, messages = make_pool(ray, list(range(10)))
    pool.work(pool.places(), lambda task, seconds, peak_mib: reported.append(task))
    assert sorted(made) == sorted(reported) == list(range(10))
    assert ray.alive == 0 and not messages


def test_ray_pool_lost_worker_has_its_task_done_by_another_once():
    ray = FakeRay(2, deadly=[4])
    pool, made, messages = make_pool(ray, list(range(6)))
    pool.work(2, lambda *done: None)
    assert sorted(made) == list(range(6)) and ray.alive == 0
    assert messages == ["a worker was lost with its process or its machine during sample 4: another worker takes over"]
    pool, made, messages = make_pool(FakeRay(2, deadly=[4, 4]), list(range(6)))
    with pytest.raises(TactipError, match="sample 4 crashed two workers"):
        pool.work(2, lambda *done: None)


def test_ray_pool_short_tasks_are_assigned_in_blocks_and_a_deadly_one_is_found():
    """The tasks of a lost worker are done by another, one by one, since any of them may have killed it."""
    ray = FakeRay(2, deadly=[400])
    pool, made, messages = make_pool(ray, list(range(1000)))
    pool.work(2, lambda *done: None)
    assert sorted(made) == list(range(1000)) and ray.alive == 0
    (block,) = [tasks for tasks in ray.given if 400 in tasks and len(tasks) > 1]
    assert f" and {len(block) - 1} more: another worker takes over" in messages[0]
    assert all((task,) in ray.given for task in block)
    assert len(ray.given) - len(block) < 40
    assert len(ray.given[-1]) == 1  # towards the end blocks are small, so all workers end together
    pool, made, messages = make_pool(FakeRay(2, deadly=[400, 400]), list(range(1000)))
    with pytest.raises(TactipError, match="sample 400 crashed two workers"):
        pool.work(2, lambda *done: None)


def test_ray_pool_task_that_fails_raises_its_error():
    ray = FakeRay(2)
    pool, made, _ = make_pool(ray, list(range(6)), wrong=3)
    with pytest.raises(TactipError, match="the disk is full"):
        pool.work(2, lambda *done: None)
    assert 3 not in made and ray.alive == 0


def test_ray_pool_without_processors_or_ray_gives_one_sentence(tmp_path, capsys, monkeypatch):
    with pytest.raises(TactipError, match="no CPU"):
        make_pool(FakeRay(0), [1])[0].places()
    monkeypatch.setitem(sys.modules, "ray", None)
    assert tactip.main(["dataset", "make", "--cluster", "auto", "--out", str(tmp_path / "set")]) == 1
    assert ".venv/bin/pip install -e '.[cluster]'" in capsys.readouterr().err
    assert not (tmp_path / "set").exists()
