"""Training on a simulator: it learns, resumes to the bit, listens to raters, and stops when it should."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy import stats

from uard.agents.continuous import ensemble_sac, sac
from uard.agents.networks import Ensemble, Network
from uard.agents.policy import CPO, PPO, TRPO
from uard.envs.locomotion.locomotion import Kick, Locomotion
from uard.envs.locomotion.regions import Vibration
from uard.lab.registry import continuous_agents
from uard.method.mitigations import Evidence, Feedback, named
from uard.training.checkpoint import CheckpointError
from uard.training.feedback import transition_model as transitions
from uard.training.feedback.transition_model import TransitionModel
from uard.training.host import loop as host
from uard.training.host import off_policy
from uard.training.host.loop import Job, TrainedRun
from uard.training.host.loops import loop_of

TINY = Network(16, 1e-3, 100.0)
ON = {"network": TINY, "ensemble": Ensemble("shared", 3), "envs": 4, "rollout": 32, "epochs": 2, "count_bonus": 0.0}
OFF = {"network": Network(16, 1e-3, 1.0), "batch": 32, "warmup": 64, "buffer": 500}
AGENTS = {
    "ppo": PPO(**ON),
    "trpo": TRPO(**ON),
    "cpo": CPO(**ON),
    "sac": sac(**OFF),
    "ensemble-sac": ensemble_sac(3, **OFF),
}
LIES = Locomotion("hopper", region=Vibration(shaking=0.5, speed=5.0), kick=Kick(10))
SMALL = TransitionModel(hidden=8, fits=5, batch=16, capacity=64)


def job(agent, mitigation="uard-0.1", steps=1024, **changes):
    return Job(LIES, AGENTS[agent], named(mitigation), 1, steps, rating_model=SMALL, evaluations=2, **changes)


def run(a_job: Job, *arguments, **options) -> TrainedRun:
    return host.run(loop_of(a_job), *arguments, **options)


def same(a, b):
    np.testing.assert_array_equal(a.log, b.log)
    np.testing.assert_array_equal(a.evaluation, b.evaluation)
    for (place, x), y in zip(jax.tree_util.tree_leaves_with_path(a.state), jax.tree.leaves(b.state), strict=True):
        np.testing.assert_array_equal(x, y, err_msg=jax.tree_util.keystr(place))


@pytest.mark.parametrize(
    ("agent", "mitigation"),
    [
        *((agent, "uard-0.1") for agent in AGENTS),
        ("ppo", "raw"),
        ("ppo", "uard-paper"),
        ("sac", "screening"),
        ("sac", "log-mean-exp"),
    ],
)
def test_every_agent_runs_with_every_kind_of_mitigation(agent, mitigation):
    done = run(job(agent, mitigation, 256))
    assert done.state.steps >= 256
    assert np.isfinite(done.log).all()
    assert 0 < done.log[:, 4].sum() <= done.state.steps
    np.testing.assert_allclose(done.ends[-1], done.ends.max())


def test_a_prediction_in_the_buffer_is_what_the_model_says_that_made_it(monkeypatch):
    """The last piece is the one after which the model is fitted for the second time: a part is drawn after that."""
    spec, drawn = SMALL, []
    real = off_policy._learn
    monkeypatch.setattr(off_policy, "_learn", lambda *given, **fixed: drawn.append(given[5]) or real(*given, **fixed))
    loop = loop_of(job("sac", "uard", 4000))
    simulator = loop.job.environment.simulator(1, 0)
    state, models = loop.start(simulator), {}
    models[0] = state.model
    for _ in range(2 * off_policy.FIT_EVERY):
        state = loop.advance(state, simulator)
        models[int(drawn[-1])] = state.model
    buffer, predicted, _ = state.extra
    fits = np.asarray(predicted.fit)
    assert sorted(models) == [0, 1, 2]
    assert set(fits.tolist()) >= {1, 2}, "what was not drawn since the fit is as it was"
    inputs = transitions.features(buffer.observation, buffer.action, buffer.next_observation, buffer.reward)
    for fit in {1, 2} & set(fits.tolist()):
        anew = transitions.read(spec, models[fit], inputs, loop.job.fixed.raters)
        for kept, new in zip(jax.tree.leaves(predicted.feedback), jax.tree.leaves(anew), strict=True):
            np.testing.assert_allclose(kept[fits == fit], new[fits == fit], rtol=1e-3, atol=1e-3)
    assert (fits == 2).mean() > 0.6, "1024 draws of 512, 0.86 of which are expected in them"


@pytest.mark.parametrize("size", [33, 40])
def test_a_buffer_of_any_size_holds_the_last_steps(size):
    several = [replace(AGENTS["sac"], batch=32, buffer=b, warmup=10_000) for b in (size, 1000)]
    small, large = (run(Job(LIES, agent, named("raw"), 1, 160, evaluations=1)).state.extra.buffer for agent in several)
    assert small.reward.shape == (64,)
    for kept, everything in zip(jax.tree.leaves(small), jax.tree.leaves(large), strict=True):
        np.testing.assert_array_equal(kept, np.concatenate([everything[128:160], everything[96:128]]))


@pytest.mark.parametrize("agent", ["ppo"])
def test_the_same_seed_gives_the_same_run_and_another_one_another(agent):
    one = run(job(agent))
    same(one, run(job(agent)))
    assert not np.array_equal(one.log[:5], run(replace(job(agent), seed=2)).log[:5])


@pytest.mark.parametrize("agent", ["ppo", "ensemble-sac"])
def test_a_run_that_was_stopped_goes_on_to_the_bit(agent, tmp_path):
    whole = run(job(agent))
    path, asked = tmp_path / "run", []

    def stop():
        asked.append(0)
        return len(asked) == 3

    with pytest.raises(KeyboardInterrupt):
        run(job(agent), path, "it", stop=stop)
    same(whole, run(job(agent), path, "it"))
    with pytest.raises(CheckpointError, match="another configuration"):
        run(job(agent), path, "something else")


# Starts a run per line of its input: what takes seconds, to import everything, it does once.
STARTER = """
import os, sys
from pathlib import Path
import numpy as np
from test_host import job, run

agent, steps, state, out = sys.argv[1:]
for _ in sys.stdin:
    pid = os.fork()
    if not pid:
        said = lambda *_: print("+", flush=True)
        done = run(job(agent, steps=int(steps)), Path(state), "it", every=32, progress=said)
        np.savez(out, log=done.log, evaluation=done.evaluation)
        os._exit(0)
    print(pid, flush=True)
    print("ended", os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""


@pytest.mark.parametrize(("agent", "steps"), [("ppo", 4096), ("sac", 1024)])
def test_kill_minus_nine_at_any_moment(agent, steps, tmp_path):
    whole, out = run(job(agent, steps=steps)), tmp_path / "out.npz"
    path = os.pathsep.join([os.path.dirname(__file__), *sys.path])
    command = [sys.executable, "-W", "ignore::RuntimeWarning", "-c", STARTER]
    random, codes = np.random.default_rng(0), []
    with subprocess.Popen(
        [*command, agent, str(steps), str(tmp_path / "state"), str(out)],
        env=os.environ | {"PYTHONPATH": path},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as starter:
        while not out.exists():
            starter.stdin.write("start\n")
            starter.stdin.flush()
            pid = int(starter.stdout.readline())
            if len(codes) < 2:
                for _ in range(random.integers(1, 8)):  # after so many pieces of work, and a moment
                    assert starter.stdout.readline() == "+\n"
                time.sleep(random.uniform(0, 0.02))
                os.kill(pid, signal.SIGKILL)
            while not (line := starter.stdout.readline()).startswith("ended"):
                assert line == "+\n"
            codes.append(int(line.split()[1]))
        starter.stdin.close()
    assert codes == [-signal.SIGKILL] * 2 + [0]
    with np.load(out) as found:
        np.testing.assert_array_equal(found["log"], whole.log)
        np.testing.assert_array_equal(found["evaluation"], whole.evaluation)


def test_half_of_what_is_rated_is_what_the_model_knows_least():
    knows = np.arange(1000.0)
    random = np.random.default_rng(0)
    asked = [transitions.chosen("doubtful", 0.2, lambda: knows, 1000, random) for _ in range(50)]
    share = np.mean(asked, 0)
    assert share.mean() == pytest.approx(0.2, abs=0.01)
    assert share[:80].mean() > 0.9
    assert share[200:].mean() == pytest.approx(0.1, abs=0.02)
    assert not transitions.chosen("doubtful", 0.0, lambda: knows, 1000, random).any()
    assert transitions.chosen("doubtful", 1.0, lambda: knows, 1000, random).all()
    blind = transitions.chosen("random", 0.2, lambda: pytest.fail("the model was asked"), 1000, random)
    assert blind.mean() == pytest.approx(0.2, abs=0.05)


def test_doubtful_steps_are_rated_in_both_loops_and_as_many():
    for agent in ("ppo", "ensemble-sac"):
        one, other = (run(job(agent, rated=0.3, query=q)) for q in ("random", "doubtful"))
        assert not np.array_equal(one.state.reservoir.inputs, other.state.reservoir.inputs)
        assert other.state.reservoir.seen[0] == pytest.approx(0.3 * other.state.steps, rel=0.25)


def test_a_state_that_is_not_finite_stops_the_run_and_the_last_good_one_stays(tmp_path, monkeypatch):
    path = tmp_path / "run"
    from uard.training.host import on_policy as host_on_policy

    real, calls = host_on_policy._learn, []

    def breaks(*args, **kwargs):
        calls.append(0)
        state, fine = real(*args, **kwargs)
        return state, fine & (len(calls) < 4)

    monkeypatch.setattr(host_on_policy, "_learn", breaks)
    with pytest.raises(FloatingPointError, match=r"environment step 384 of seed 1"):
        run(job("ppo"), path, "it", every=1)
    monkeypatch.undo()
    same(run(job("ppo")), run(job("ppo"), path, "it"))


def test_ppo_learns_to_stay_up_on_the_honest_hopper():
    """On six seeds together the last 50 episodes last more than twice as long as the first 50.

    By about 20 and 80 steps here. Under the hypothesis that they do not, the difference has either sign equally often
    in each seed: p = 1/64 if all six have the same.
    """
    ppo = continuous_agents()["ppo"]
    logs = [run(Job(Locomotion(region=None), ppo, named("raw"), seed, 14_336, evaluations=1)).log for seed in range(6)]
    gains = [log[-50:, 4].mean() - 2 * log[:50, 4].mean() for log in logs]
    test = stats.permutation_test((gains,), np.mean, permutation_type="samples", alternative="greater")
    assert test.pvalue < 0.05, gains


def test_a_reservoir_is_a_uniform_sample_of_all_that_was_rated():
    kept = transitions.empty(SMALL, 1, 3)
    random = np.random.default_rng(0)
    counts = np.zeros(640)
    for _ in range(200):
        kept.seen[0] = 0
        for start in range(0, 640, 32):
            rows = np.arange(start, start + 32, dtype=float)[:, None]
            transitions.keep(kept, rows, np.zeros((32, 3)), random)
        counts[kept.inputs[:, 0].astype(int)] += 1
    # 200 x 64 of 640 places: 20 each, sd about 4.2
    assert counts.sum() == 200 * 64
    assert abs(counts[:64].mean() - 20) < 2
    assert abs(counts[-64:].mean() - 20) < 2


def test_the_model_of_transitions_learns_what_raters_say_and_how_far_that_is_from_the_proxy():
    random = np.random.default_rng(0)
    spec = TransitionModel(fits=1500, capacity=2048)
    x = random.normal(size=(2048, 4)).astype(np.float32)
    hack = x[:, 0] > 1.0
    x[:, -1] = x[:, 1] + 4.0 * hack  # the observed reward
    true = x[:, 1] - 1.5 * hack
    ratings = true[:, None] + random.normal(size=(2048, 3)) * np.where(hack, 1.0, 0.2)[:, None]
    kept = transitions.empty(spec, 4, 3)
    transitions.keep(kept, x, ratings, random)
    model = transitions.init(spec, jax.random.key(0), 4, 3)
    model = transitions.fit(spec, model, kept, jax.random.key(1))
    said = transitions.read(spec, model, jax.numpy.asarray(x), 3)
    assert np.sqrt(np.mean((np.asarray(said.mean) - true) ** 2)) < 0.25
    assert np.asarray(said.sd)[hack].mean() > 3 * np.asarray(said.sd)[~hack].mean()


def test_the_model_of_transitions_knows_that_nobody_rated_a_step_with_such_a_bonus():
    random = np.random.default_rng(0)
    spec = TransitionModel(fits=1500, capacity=2048)
    x = random.normal(size=(2048, 4)).astype(np.float32)
    rated, never = x[:, 0] < 0.5, x[:, 0] > 1.0
    x[:, -1] = x[:, 1] + 4.0 * never
    kept = transitions.empty(spec, 4, 3)
    transitions.keep(kept, x[rated], x[rated, 1:2] + random.normal(size=(rated.sum(), 3)) * 0.2, random)
    model = transitions.init(spec, jax.random.key(0), 4, 3)
    model = transitions.fit(spec, model, kept, jax.random.key(1))
    count = np.asarray(transitions.read(spec, model, jax.numpy.asarray(x), 3).count)
    assert np.median(count[never]) < 0.2 * np.median(count[rated])


def test_raters_who_are_all_noisy_are_still_known_and_the_lowest_of_them_does_not_sink():
    random = np.random.default_rng(0)
    spec = TransitionModel(fits=1500)
    x = random.normal(size=(8192, 4)).astype(np.float32)
    true = x[:, 1]
    kept = transitions.empty(spec, 4, 3)
    transitions.keep(kept, x, true[:, None] + 1.2 * random.normal(size=(8192, 3)), random)
    model = transitions.init(spec, jax.random.key(0), 4, 3)
    model = transitions.fit(spec, model, kept, jax.random.key(1))
    said = transitions.read(spec, model, jax.numpy.asarray(x), 3)
    assert np.median(said.count) > 3
    # What the lowest of three such ratings is on average: 0.85 deviations less.
    assert np.median(np.asarray(said.lowest) - true) > -0.07 * 0.85 * 1.2
    assert np.median(said.sd) > 0.7
    # All steps are disputed alike: that the predictions of how far differ is their error (0.09 apart as predicted).
    low, high = np.percentile(said.sd, [5, 95])
    assert high - low < 0.04


def test_a_difference_counts_as_far_as_it_is_more_than_its_deviation():
    means = jax.numpy.array([-3.0, -0.5, 0.0, 0.5, 3.0])
    members = jax.numpy.stack([means - 1.0, means, means + 1.0])
    np.testing.assert_allclose(transitions.soft_threshold(members, 1.0), [-2.0, 0.0, 0.0, 0.0, 2.0], rtol=1e-6)
    np.testing.assert_allclose(transitions.soft_threshold(members, 0.0), means, rtol=1e-6)


def test_the_anchor_of_a_predicted_step_is_the_prediction_however_little_it_is_worth():
    columns = [[1.0, 5.0], [0.0, 0.0], [-2.0, 3.0], [1.0, 1.0], [4.0, 4.0], [3.0, 3.0]]
    f = Feedback(*map(jax.numpy.array, columns))
    for m in (named("uard-0.1"), named("worst-of-annotations")):
        statistics = m.fit(f, jax.numpy.ones(2, bool))
        assert float(statistics.lowest) == 0.5
        expected = transitions.expecting(statistics, f)
        np.testing.assert_array_equal(expected.lowest, f.lowest)
        assert expected.scale is statistics.scale
    uard = named("uard-0.1")
    anchor = uard.reward_anchor(f.proxy, f, transitions.expecting(uard.fit(f, f.count > 0), f))
    np.testing.assert_allclose(anchor, [-2.0, 3.0], rtol=1e-6)
    assert transitions.expecting((), f) == ()


@pytest.mark.parametrize("name", ["median", "min-proxy-mean", "min-proxy-median", "uwo", "log-mean-exp", "excess"])
def test_before_the_first_fit_nothing_is_known_and_the_reward_is_believed(name):
    model = transitions.init(SMALL, jax.random.key(0), 4, 3)
    inputs = 5.0 * jax.random.normal(jax.random.key(1), (50, 4))
    feedback = transitions.read(SMALL, model, inputs, 3)
    assert (feedback.count == 0).all()
    mitigation = named(name)
    statistics = mitigation.fit(feedback, feedback.count > 0)
    learned = mitigation.signal(Evidence(inputs[:, -1], np.zeros(50, np.float32), feedback), statistics).reward
    assert np.isfinite(learned).all()
    if name not in ("excess",):  # which believes what nobody has rated in part
        np.testing.assert_array_equal(learned, inputs[:, -1])


def test_without_ratings_the_model_stays_as_it_was():
    model = transitions.init(SMALL, jax.random.key(0), 3, 2)
    kept = transitions.empty(SMALL, 3, 2)
    after = transitions.fit(SMALL, model, kept, jax.random.key(1))
    for a, b in zip(jax.tree.leaves(model.layers), jax.tree.leaves(after.layers), strict=True):
        np.testing.assert_array_equal(a, b)
