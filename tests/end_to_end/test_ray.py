import importlib
import os
import socket
import sqlite3
import sys
import time
from dataclasses import dataclass

import pytest

from uard import InvalidValueError, LearningSignal, Mitigation
from uard.agents.tabular import QLearning
from uard.cli import app as cli
from uard.cli.reproduce import Reproduce
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.cell import Cell
from uard.lab.execution import cluster, runner
from uard.lab.execution.cluster import ClusterError, Ray
from uard.lab.execution.runner import StudyFailedError
from uard.lab.execution.store import Store
from uard.method.mitigations import named

# Ray leaves its own processes to end on their own.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:subprocess .* is still running:ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
ray = pytest.importorskip("ray", reason="the extra uard[ray] is not installed")

GRID = TrapGrid(size=4, traps=((1, 2),), horizon=8)
WALKER = QLearning(heads=1, epsilon=1.0, epsilon_decay=1.0, epsilon_min=1.0)
ALONE = """
from dataclasses import dataclass
from uard import LearningSignal, Mitigation

@dataclass(frozen=True)
class Unknown(Mitigation):
    def signal(self, evidence, usual):
        return LearningSignal(evidence.reward, 1.0)

def elsewhere(data, versions):
    return []
"""


def walks(n):
    """One batch each, of one program: episodes that last until a random walker stumbles upon the goal."""
    return [(Cell(TrapGrid(10, horizon=5000 + i), agent=WALKER, episodes=400), 0) for i in range(n)]


def small(mitigation=None):
    return Cell(GRID, mitigation or named("uard-0.1"), episodes=30)


@dataclass(frozen=True)
class Dies(Mitigation):
    def signal(self, evidence, usual):
        os._exit(41)


@pytest.fixture(scope="module")
def cluster_of_two():
    """A head without cores and two nodes of one core each."""
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_worker_niceness", "0")  # Ray's 15 starves on a busy machine
        made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        nodes = [made.add_node(num_cpus=1, wait=False), made.add_node(num_cpus=1, wait=False)]
        made.wait_for_nodes()
        yield made, nodes
        ray.shutdown()
        made.shutdown()


@pytest.fixture
def alone(tmp_path, monkeypatch):
    """A module that this process has and no node can import."""
    (tmp_path / "ray_alone.py").write_text(ALONE)
    with monkeypatch.context() as patch:
        patch.syspath_prepend(tmp_path)
        return importlib.import_module("ray_alone")


def blobs(store):
    with sqlite3.connect(store.path) as db:
        return db.execute("select key, seed, data, checksum, metrics from results order by key, seed").fetchall()


def test_a_lost_node_changes_no_byte_of_the_results(cluster_of_two, tmp_path):
    made, nodes = cluster_of_two
    jobs = [*walks(7), (small(), 0), (small(), 1)]
    here, there = Store(tmp_path / "here.sqlite"), Store(tmp_path / "there.sqlite")
    left = []

    def lose_a_node(done, total, _):
        if done >= 2 and len(nodes) == 2:
            made.remove_node(nodes.pop(), allow_graceful=False)
            left.append(total - done)

    assert runner.run(jobs, there, progress=lose_a_node, engine=Ray(made.address)) == len(jobs)
    assert left[0] >= 3
    assert not ray.is_initialized()
    assert runner.run(jobs, here, workers=0) == len(jobs)
    assert blobs(there) == blobs(here)
    assert len(blobs(here)) == len(jobs)
    here.close()
    there.close()


def test_what_fails_is_told_apart_and_the_rest_is_stored(alone, monkeypatch):
    """On a Ray that is started for it, and ended."""

    @dataclass(frozen=True)
    class Local(Mitigation):
        def signal(self, evidence, usual):
            return LearningSignal(evidence.reward, 1.0)

    monkeypatch.setattr(cluster, "RETRIES", 0)
    monkeypatch.setenv("RAY_worker_niceness", "0")
    store, bad, good = Store(":memory:"), [small(alone.Unknown()), small(Dies())], [small(), small(Local())]
    with pytest.raises(StudyFailedError) as caught:
        runner.run([(c, 0) for c in (*bad, *good)], store, engine=Ray())
    assert not ray.is_initialized()
    errors = {f.jobs[0][0]: f.error for f in caught.value.failures}
    assert errors.keys() == set(bad)
    assert "No module named 'ray_alone'" in errors[bad[0]]
    assert errors[bad[1]].startswith("the batch was lost with its worker or node 1 times")
    assert [store.have(c) for c in good] == [{0}, {0}]
    store.close()


def test_a_connection_of_the_users_own_is_used_and_stays(cluster_of_two, alone, monkeypatch):
    """With a package that no node has, and for more than the nodes have."""
    ray.init(cluster_of_two[0].address, log_to_driver=False, logging_level="ERROR")
    monkeypatch.setattr(cluster, "train_on_node", alone.elsewhere)
    batch = [(small(), 1)]
    ((back, answer),) = Ray()([batch], None, list)
    assert back == batch
    assert answer.endswith("(and your own package) must be installed on every node of the cluster")
    with pytest.raises(ClusterError, match=r"no node of the Ray cluster has 1 CPU and 1 GPU for a task; it has"):
        list(Ray(gpus=1)([batch], None, list))
    assert list(Ray()([batch], None, lambda batch: [])) == []
    assert ray.is_initialized()
    ray.shutdown()


def test_a_node_of_other_versions_is_refused():
    answer = cluster.train_on_node(b"", {p: cluster.version_of(p) for p in cluster.NEEDED} | {"jax": "0.1"})
    assert answer.startswith("this node has {'jax': '")
    assert "the driver {'jax': '0.1'}" in answer
    assert cluster.version_of("no-such-package") is None


def test_an_address_where_nobody_answers_is_refused_within_seconds(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as mute, socket.create_server(("127.0.0.1", 0)) as gone:
        port = gone.getsockname()[1]
        gone.close()
        started = time.monotonic()
        for address, why in ((f"127.0.0.1:{port}", "refused"), (f"127.0.0.1:{mute.getsockname()[1]}", "within 3 s")):
            with pytest.raises(ClusterError, match=rf"no Ray cluster answers there \(.*{why}"):
                cluster.check_alive(address, patience=3)
        assert time.monotonic() - started < 30


@pytest.mark.parametrize("address", ["", "somewhere", "ray://head:10001", "head:", ":6379", "head:port"])
def test_an_address_that_is_none_is_refused(address):
    with pytest.raises(InvalidValueError, match="host:port"):
        Ray(address)


@pytest.mark.parametrize("gpus", [-1, 65, float("nan")])
def test_a_share_of_gpus_that_is_none_is_refused(gpus):
    with pytest.raises(InvalidValueError, match="gpus"):
        Ray(gpus=gpus)


def test_the_command_line_says_which_cluster():
    command = Reproduce(engine="ray", address="head:6379", gpus=0.5)
    assert command._engine() == Ray("head:6379", 0.5)
    assert Reproduce()._engine() is None


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--engine", "ray", "--address", "127.0.0.1:1"), "no Ray cluster answers there"),
        (("--engine", "ray", "--workers", "2"), "workers = 2: must be left out with --engine ray"),
        (("--address", "auto"), "address = 'auto': must be left out without --engine ray"),
        (("--gpus", "0.5"), "gpus = 0.5: must be left out without --engine ray"),
        (("--engine", "rai"), "one of local, ray (did you mean 'ray'?)"),
    ],
)
def test_what_does_not_go_together_is_said(capsys, tmp_path, options, says):
    with pytest.raises(SystemExit) as left:
        cli.main(["reproduce", "control", "--seeds", "2", "--store", str(tmp_path / "s.sqlite"), *options])
    assert left.value.code == 2
    assert says in " ".join(capsys.readouterr().err.split())


def test_a_missing_ray_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ClusterError, match=r"pip install 'uard\[ray\]'"):
        list(Ray()([[(small(), 0)]], None, list))
