"""Batches on a Ray cluster: what ``runner.run`` takes as its engine. Needs the extra ``uard[ray]``.

The process that calls ``runner.run`` (the driver) hands out batches as Ray tasks and alone writes what comes back into
the store. A batch is trained the same wherever and however often it is trained, so a batch that goes down with its node
is simply trained again.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from uard import _checks
from uard.lab.execution.batching import Job
from uard.lab.execution.training import Answer, attempt, attempt_packed, packed
from uard.lab.execution.workers import Claim, Outcomes

RETRIES = 5  # nodes that may be lost under one batch before it counts as failed
AHEAD = 2  # batches handed out per slot of the cluster, so that none waits for the driver
NEEDED = ("uard", "jax", "jaxlib", "numpy", "optax")  # nodes must have the driver's versions: others give other results


class ClusterError(RuntimeError):
    """No cluster to work on; the message says what to do."""


@dataclass(frozen=True)
class Ray:
    """A Ray cluster as an engine of ``runner.run``: ``run(jobs, store, engine=Ray("head:6379"))``.

    Nothing is connected before batches are handed out.

    Examples:
        >>> Ray("head:6379", gpus=0.25)  # four tasks share a GPU
        Ray(address='head:6379', gpus=0.25, checkpoints=None)

    Attributes:
        address: ``host:port`` of its head, ``auto`` for the one that this machine belongs to; None starts one on this
            machine's cores and ends it afterwards. A cluster that this process is connected to already is used as it
            is, and stays.
        gpus: GPUs of a task, in [0, 64]; a fraction shares one. A task has one CPU besides.
        checkpoints: A folder that all nodes see, in which long runs (MuJoCo) keep their checkpoints, so that one whose
            node is lost goes on from there; None starts such a run again.
    """

    address: str | None = None
    gpus: float = 0.0
    checkpoints: Path | None = None

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            InvalidValueError: naming the setting, its value and what is allowed.
        """
        _checks.number("gpus", self.gpus, low=0, high=64)
        if self.address not in (None, "auto"):
            host, _, port = self.address.rpartition(":")
            if not host or "/" in host or not port.isdigit():
                allowed = "host:port of the cluster's head (run this command on one of its nodes), auto, or left out"
                raise _checks.InvalidValueError("address", self.address, allowed)

    def __call__(self, queue: list[list[Job]], folder: Path | None, claim: Claim) -> Outcomes:
        """Train batches on the cluster; yield each with its answers as soon as they are there.

        Args:
            queue: Batches, the longest first.
            folder: The driver's folder of checkpoints. Other nodes need not see it, so only a batch that cannot be
                pickled, and is therefore trained in this process, uses it.
            claim: Says what of a batch is to be trained, when it is handed out.

        Raises:
            ClusterError: Ray is not installed, no cluster answers, or it has no room for a single task.
        """
        local: list[list[Job]] = []
        with _connected(self.address) as ray:
            yield from self._train(ray, queue, claim, local)
        for batch in local:
            yield batch, attempt(batch, folder)

    def _train(self, ray: Any, queue: list[list[Job]], claim: Claim, local: list[list[Job]]) -> Outcomes:
        """Train what can be pickled; the rest is left in ``local``."""
        if not self._slots(ray):
            have = {k: v for k, v in ray.cluster_resources().items() if k in ("CPU", "GPU")}
            raise ClusterError(f"no node of the Ray cluster has 1 CPU and {self.gpus:g} GPU for a task; it has {have}")
        task = ray.remote(train_on_node).options(num_cpus=1, num_gpus=self.gpus, max_retries=RETRIES)
        versions = {package: version_of(package) for package in NEEDED}
        waiting = (mine for batch in queue if (mine := claim(batch)))
        flying: dict[Any, list[Job]] = {}

        def launch() -> None:
            room = max(AHEAD * self._slots(ray), 1)
            while len(flying) < room and (batch := next(waiting, None)) is not None:
                data = packed(batch, self.checkpoints)
                if data is None:
                    local.append(batch)
                else:
                    flying[task.remote(data, versions)] = batch

        launch()
        try:
            while flying:
                finished, _ = ray.wait(list(flying), num_returns=1)
                for reference in finished:
                    batch = flying.pop(reference)
                    answer = _answer_of(ray, reference)
                    launch()
                    yield batch, answer
        finally:
            for reference in flying:
                ray.cancel(reference, force=True)

    def _slots(self, ray: Any) -> int:
        """Return how many tasks fit into the cluster as it is now."""
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        room = [(n.get("CPU", 0.0), n.get("GPU", 0.0) / self.gpus if self.gpus else float("inf")) for n in nodes]
        return sum(int(min(node)) for node in room)


def train_on_node(data: bytes, versions: dict[str, str | None]) -> Answer:
    """Train a packed batch on the node on which this runs.

    Args:
        data: See ``training.packed``.
        versions: Of the driver's packages, by name; a node with others trains nothing.
    """
    other = {p: here for p in versions if (here := version_of(p)) != versions[p]}
    if other:
        driver = {p: versions[p] for p in other}
        return f"this node has {other}, the driver {driver}: install the same on every node"
    return attempt_packed(data)


def version_of(package: str) -> str | None:
    """Return the version of an installed package, None if there is none."""
    if package == "uard":
        from uard import __version__

        return __version__
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _answer_of(ray: Any, reference: Any) -> Answer:
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError:
        return f"{traceback.format_exc()}\nuard (and your own package) must be installed on every node of the cluster"
    except ray.exceptions.RayError as error:
        return f"the batch was lost with its worker or node {RETRIES + 1} times, or for good: {error}"


@contextmanager
def _connected(address: str | None) -> Iterator[Any]:
    """Connect to a cluster, or start one, and leave it (end it) at last."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ClusterError(f"the engine ray is not installed: pip install 'uard[ray]' ({error})") from None
    if ray.is_initialized():
        yield ray
        return
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    try:
        if address is None:
            _start(ray, quiet)
        else:
            check_alive(address)
            ray.init(address=address, **quiet)
    except ClusterError:
        raise
    except Exception as error:  # a bare Exception is what Ray raises if its own processes start too slowly
        ray.shutdown()
        if address is None:
            raise ClusterError(f"Ray could not be started on this machine: {error}") from error
        raise _no_answer(address, error) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _start(ray: Any, quiet: dict[str, Any]) -> None:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    with warnings.catch_warnings():
        # JAX warns of forks, for it has threads; Ray's children use no JAX and replace themselves at once.
        warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
        ray.init(address="local", num_cpus=cores, include_dashboard=False, **quiet)


def check_alive(address: str, patience: float = 20.0) -> None:
    """Ask a cluster whether it is alive, for some seconds; ``ray.init`` itself would wait for minutes.

    Raises:
        ClusterError: it does not answer.
    """
    command = [sys.executable, "-m", "ray.scripts.scripts", "health-check"]
    if address != "auto":
        host, _, port = address.rpartition(":")
        try:
            socket.create_connection((host, int(port)), timeout=5).close()
        except (OSError, OverflowError) as error:
            raise _no_answer(address, error) from None
        command += ["--address", address]
    try:
        subprocess.run(command, capture_output=True, timeout=patience, check=True)
    except (subprocess.TimeoutExpired, subprocess.CalledProcessError):
        raise _no_answer(address, f"it did not answer within {patience:g} s") from None


def _no_answer(address: str, why: object) -> ClusterError:
    return ClusterError(
        f"address = {address!r}: no Ray cluster answers there ({why}); start one with `ray start --head`, or leave the "
        "address out to use this machine"
    )
