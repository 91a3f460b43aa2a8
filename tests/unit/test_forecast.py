import heapq
import random

import pytest

from uard.agents.value import DeepQ
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.cell import Cell
from uard.lab.execution.batching import batches, shape_of
from uard.lab.execution.forecast import Forecast
from uard.method.mitigations import named

COMPILE = 3.0


def jobs():
    """Short and long cells, several programs, two kinds of agents."""
    short = [Cell(TrapGrid(6), named(m), episodes=100 + n) for m in ("raw", "uard-0.1") for n in range(10)]
    long = [Cell(TrapGrid(10), named(m), episodes=1000 + n) for m in ("raw", "uard-0.1") for n in range(4)]
    deep = [Cell(TrapGrid(6), named("raw"), DeepQ(), episodes=n) for n in (10, 20, 30)]
    return [(cell, seed) for cell in (*short, *long, *deep) for seed in range(2)]


def kind(cell):
    return "dqn" if isinstance(cell.agent, DeepQ) else cell.mitigation


def shape(cell):
    """Programs as the runner's, but for the number of episodes, so that each has several batches."""
    return (kind(cell), type(cell.agent)), shape_of(cell)[1]


def simulated(workers, noise=0.1):
    """Yield (seconds that remain, seconds forecast, seconds that a plain average says) after every batch."""
    chance = random.Random(0)
    queue = batches(jobs())
    forecast, busy, warm, clock = Forecast(queue, workers, shape), [], [set() for _ in range(workers)], 0.0
    waiting, said, total, done = list(queue), [], sum(map(len, queue)), 0

    def give(worker):
        if waiting:
            batch = waiting.pop(0)
            program, cost = shape(batch[0][0])
            rate = 1e-5 if program[0] != "dqn" else 3e-7
            seconds = cost * len(batch) * rate * chance.uniform(1 - noise, 1 + noise)
            seconds += 0 if program in warm[worker] else COMPILE
            warm[worker].add(program)
            forecast.begin(batch, clock)
            heapq.heappush(busy, (clock + seconds, worker, batch))

    for worker in range(workers):
        give(worker)
    assert forecast.remaining(0.0) is None
    while busy:
        clock, worker, batch = heapq.heappop(busy)
        forecast.end(batch, clock)
        done += len(batch)
        give(worker)
        said.append((clock, forecast.remaining(clock), clock / done * (total - done)))
    return [(clock - moment, said_, plain) for moment, said_, plain in said]


@pytest.mark.parametrize("workers", [1, 2])
def test_what_remains_is_foretold_better_than_by_a_plain_average(workers):
    told = [x for x in simulated(workers) if x[1] is not None]
    assert len(told) > 20
    assert sum(abs(said - true) for true, said, _ in told) < 0.5 * sum(abs(plain - true) for true, _, plain in told)
    if workers == 1:  # every program has run: nothing is left to be compiled
        assert all(said == pytest.approx(true, rel=0.1, abs=0.1) for true, said, _ in told[len(told) // 2 :])
    assert told[-1][:2] == (0.0, 0.0)


def test_many_workers_do_not_make_the_longest_batch_shorter():
    cell = Cell(episodes=100)
    several = [[(cell, seed)] for seed in range(4)]
    forecast = Forecast(several, 2, lambda _: ("p", 10.0))
    for i in (0, 1):
        forecast.begin(several[i], 10.0 * i)
        forecast.end(several[i], 10.0 * i + 10)
    forecast.begin(several[2], 20.0)
    assert forecast.remaining(20.0) == pytest.approx(10)
    forecast.drop(several[3])
    assert forecast.remaining(25.0) == pytest.approx(5)
    assert forecast.remaining(99.0) == 0
