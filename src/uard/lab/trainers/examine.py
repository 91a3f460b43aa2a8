"""What an agent trained in MuJoCo makes of a lie or a kick after training (G10, G12-G15), and what sigma_m knows.

The paper defines neither the distortion nor the "confidence-adjusted reward". These definitions are OURS, those of the
grids (``uard.replication.distortion``) where they can be:

* The trained agent walks 1000 steps with its most likely actions. In three windows an adversary adds 4, the regions'
  bonus, to the observed reward of every step; the raters tell the truth as they see it.
* The confidence-adjusted reward is what the agent would learn from: the mitigation's; for SUNRISE times the weight of
  its backup; for EDAC less the critics' pessimism, mean less lowest.
* The advantage of the agent's action over a random one (G13) is that of one step ahead, r + gamma V(s'), on the learned
  critics, with the reward of the random action's step raised by epsilon and then filtered.
* A robot is kicked once (G10): 16 copies walk, and after step 50 the forward velocity is raised by 0, by 1, or by the
  paper's 5. The paper kicks at step 500; there those of our agents that do their task have mostly fallen. What is said
  of a step is the mean over the copies that still stand before it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from uard.envs.locomotion.locomotion import ROOT, Kick, Locomotion
from uard.envs.simulator import StepResult
from uard.method import calibration
from uard.method.mitigations import Evidence, Explanation, Feedback, RatedReward
from uard.ratings.aggregate import nothing

STEPS = 1000
WINDOWS = ((200, 220), (400, 420), (750, 770))
BONUS = 4.0
EVERY = 10  # steps between two that are tried with a random action, too
EPSILONS = np.linspace(0.0, 8.0, 17)
THROWN = 1.0  # m, rad, m/s or rad/s, of one coordinate of a state that was never visited
WORST = 0.75  # errors above this quantile are what sigma_m is to warn of
COPIES, KICKED_AT, KICKED_STEPS = 16, 50, 150
KICKS = (0.0, 1.0, 5.0)  # m/s; the paper's is the last

CAUTION = RatedReward("bound")  # a static pessimist: mean - sd over the ratings and the observed reward

# Columns of what is found.
TRACE = ("observed", "adjusted", "caution", "lam", "true")
PERTURBED = ("filtered", "raw", "sign_kept_filtered", "sign_kept_raw")
WARNING = ("auroc_thrown", "auroc_error")
REACTION = ("activations", "believed", "lambda_inside", "lambda_outside")
KICKED = ("standing", "sigma_m", "sigma_h", "weight", "observed", "adjusted", "true")


def inside() -> np.ndarray:
    """Return which steps lie in a window, (STEPS,)."""
    steps = np.arange(STEPS)
    return np.any([(steps >= a) & (steps < b) for a, b in WINDOWS], axis=0)


def reaction(trace: np.ndarray) -> tuple[float, ...]:
    """Say how a (STEPS, len(TRACE)) trace reacts to the windows: see ``REACTION``.

    An exploit activation is a step in a window whose adjusted reward exceeds the true one by more than half of what
    the adversary adds; believed is the mean of adjusted less true in the windows, as a share of what is added.
    """
    _, adjusted, _, lam, true = trace.T
    here = inside()
    too_much = (adjusted - true)[here]
    return (too_much > BONUS / 2).sum(), too_much.mean() / BONUS, lam[here].mean(), lam[~here].mean()


def backup_trust(sigma_m: np.ndarray, temperature: float) -> np.ndarray:
    """``agents.value.backup_weight``, on the host and of a sigma_m that is known."""
    return 1.0 / (1.0 + np.exp(temperature * sigma_m)) + 0.5


class Walked(NamedTuple):
    """Steps (B, ...) and what came of them."""

    observation: np.ndarray
    action: np.ndarray
    result: StepResult


def examine(loop: Any, state: Any) -> dict[str, np.ndarray]:
    """Examine a trained agent.

    Args:
        loop: Of the run, a ``training.host.loop.Loop``.
        state: Its last state.

    Returns:
        ``trace`` (STEPS, len(TRACE)) of the distorted walk; ``perturbed`` (len(EPSILONS), len(PERTURBED)): means over
        the states in which the agent's action is the better one; ``warning`` (len(WARNING),): chance that sigma_m is
        larger at a state thrown off by ``THROWN`` than at a visited one, and where the value is among the most wrong
        quarter than elsewhere. Of a robot also ``kicked`` (len(KICKS), KICKED_STEPS, len(KICKED)): the share of copies
        that stand before the step, and means over them (0 where none does) of sigma_m after the step, and of its
        sigma_h, weight, observed, adjusted and true reward.
    """
    reward_fn = _RewardFn(loop, state)
    own, rival = _walk(loop, state)
    observed = own.result.reward + BONUS * inside()
    adjusted, caution, lam = reward_fn(own, observed)
    trace = np.column_stack([observed, adjusted, caution, lam, own.result.true_reward])
    found = {"trace": trace, "perturbed": _perturbed(reward_fn, own, rival), "warning": _warning(reward_fn, own)}
    if isinstance(loop.job.environment, Locomotion):
        found["kicked"] = np.stack([_kicked(reward_fn, size) for size in KICKS])
    return {name: value.astype(np.float32) for name, value in found.items()}


def _walk(loop: Any, state: Any) -> tuple[Walked, Walked]:
    """Return the agent's steps, and what a random action would have led to in every ``EVERY``-th of its states."""
    from uard.training.host import loop as host

    job = loop.job
    random = host.generator(job.seed, host.EVALUATION, 1)
    simulator = job.environment.simulator(1, int(random.integers(2**63)))
    own: list[Walked] = []
    rival: list[Walked] = []
    for t in range(STEPS):
        here = simulator.observe()
        if t % EVERY == 0:
            saved = simulator.save()
            other = random.uniform(-1.0, 1.0, (1, job.environment.actions))
            rival.append(Walked(here, other, simulator.step(other)))
            simulator.load(saved)
        action = np.clip(loop.act(state, here), -1.0, 1.0)
        own.append(Walked(here, action, simulator.step(action)))
    return _joined(own), _joined(rival)


def _joined(steps: list[Walked]) -> Walked:
    observation, action, results = zip(*steps, strict=True)
    return Walked(
        np.concatenate(observation),
        np.concatenate(action),
        StepResult(*map(np.concatenate, zip(*results, strict=True))),
    )


class _RewardFn:
    """The filter of a trained agent, by itself."""

    def __init__(self, loop: Any, state: Any):
        import jax

        from uard.training.feedback import transition_model as transitions

        self.job, self.state, self.loop = loop.job, state, loop
        job = self.job
        self.raters = job.fixed.raters
        self.read = jax.jit(partial(transitions.read, job.rating_model, raters=self.raters))
        self.statistics: dict[Any, Any] = {job.mitigation: ()}
        if job.asks_raters:
            measure = jax.jit(transitions.panel_statistics, static_argnames=("mitigation", "spec", "raters"))
            sample, seen = state.reservoir.inputs, state.reservoir.seen[0]
            for m in (job.mitigation, CAUTION):
                found = measure(m, job.rating_model, state.model, sample, seen, raters=self.raters)
                self.statistics[m] = jax.tree.map(lambda x: np.asarray(x, float), found)

    def values(self, observations: np.ndarray) -> np.ndarray:
        """Return all critics' values, (N, B)."""
        return np.asarray(self.loop.values(self.state, observations), float)

    def value(self, observations: np.ndarray) -> np.ndarray:
        """Return their mean, (B,)."""
        return self.values(observations).mean(0)

    def doubt(self, observations: np.ndarray) -> np.ndarray:
        """Return sigma_m of states, (B,)."""
        values = self.values(observations)
        return values.std(0, ddof=1) if len(values) > 1 else np.zeros(values.shape[1])

    def __call__(self, steps: Walked, reward: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what the agent and a static pessimist would learn from steps so rewarded, and lambda_t; (B,) each."""
        adjusted, caution, why = self.explain(steps, reward)
        return adjusted, caution, np.zeros(len(reward)) + np.asarray(why.lam)

    def explain(self, steps: Walked, reward: np.ndarray) -> tuple[np.ndarray, np.ndarray, Explanation]:
        """Return the first two of these, and why the agent believes the reward as far as it does."""
        from uard.training.feedback import transition_model as transitions

        agent, mitigation, result = self.job.agent, self.job.mitigation, steps.result
        ahead = np.where(result.terminated, 0.0, agent.gamma * self.doubt(result.observation))
        evidence = Evidence(reward, ahead, self._feedback(steps, reward))
        statistics = {m: transitions.expecting(s, evidence.feedback) for m, s in self.statistics.items()}
        why = mitigation.explain(evidence, statistics[mitigation])
        adjusted = np.asarray(why.signal.reward, float)
        values = self.values(steps.observation)
        if heat := getattr(agent, "backup_temperature", 0.0):
            adjusted = adjusted * backup_trust(values.std(0, ddof=1), heat)
        elif getattr(agent, "diversity", 0.0):
            adjusted = adjusted - (values.mean(0) - values.min(0))
        caution = reward
        if self.job.asks_raters:
            caution = np.asarray(CAUTION.signal(evidence, statistics[CAUTION]).reward)
        return adjusted, caution, why

    def _feedback(self, steps: Walked, reward: np.ndarray) -> Feedback:
        from uard.training.feedback import transition_model as transitions

        if not self.job.asks_raters:
            return nothing((len(reward),), self.raters)
        inputs = transitions.features(steps.observation, steps.action, steps.result.observation, reward)
        return self.read(self.state.model, inputs.astype(np.float32)).map(lambda x: np.asarray(x, float))


def _perturbed(reward_fn: _RewardFn, own: Walked, rival: Walked) -> np.ndarray:
    chosen = Walked(own.observation[::EVERY], own.action[::EVERY], StepResult(*(x[::EVERY] for x in own.result)))
    ahead, ahead_of_rival = (
        np.where(w.result.terminated, 0.0, reward_fn.job.agent.gamma * reward_fn.value(w.result.observation))
        for w in (chosen, rival)
    )
    raised = rival.result.reward + EPSILONS[:, None]
    filtered = reward_fn(chosen, chosen.result.reward)[0] - np.array([reward_fn(rival, r)[0] for r in raised])
    columns = []
    for gap in (filtered, chosen.result.reward - raised):
        gaps = (gap + ahead - ahead_of_rival)[:, gap[0] + ahead - ahead_of_rival > 0]
        none = np.zeros(len(EPSILONS))
        columns.append((gaps.mean(1), (gaps > 0).mean(1)) if gaps.size else (none, none))
    (gap_filtered, kept_filtered), (gap_raw, kept_raw) = columns
    return np.column_stack([gap_filtered, gap_raw, kept_filtered, kept_raw])


def _warning(reward_fn: _RewardFn, own: Walked) -> np.ndarray:
    from uard.training.host import loop as host

    random = host.generator(reward_fn.job.seed, host.EVALUATION, 2)
    rows, width = own.observation.shape
    thrown = own.observation.copy()
    thrown[np.arange(rows), random.integers(width, size=rows)] += THROWN * random.choice([-1.0, 1.0], rows)
    sigma = reward_fn.doubt(own.observation)
    new = calibration.auroc(np.concatenate([sigma, reward_fn.doubt(thrown)]), np.arange(2 * rows) >= rows)
    reward, result = reward_fn(own, own.result.reward)[0], own.result
    after, value = reward_fn.value(result.observation), reward_fn.value(own.observation)
    earned, next_return = np.zeros(rows), after[-1]
    for t in range(rows - 1, -1, -1):
        next_return = 0.0 if result.terminated[t] else after[t] if result.truncated[t] else next_return
        next_return = earned[t] = reward[t] + reward_fn.job.agent.gamma * next_return
    error = np.abs(value - earned - np.median(value - earned))
    wrong = error > np.quantile(error, WORST)
    return np.array([new, calibration.auroc(sigma, wrong) if wrong.any() else 0.5])


def _kicked(reward_fn: _RewardFn, size: float) -> np.ndarray:
    """Return what is found along an episode with a kick of some size, (KICKED_STEPS, len(KICKED))."""
    from uard.training.host import loop as host

    job, loop, state = reward_fn.job, reward_fn.loop, reward_fn.state
    forward = job.environment.actions + ROOT - 1
    kicked = replace(job.environment, kick=Kick(KICKED_AT, size, forward))
    simulator = kicked.simulator(COPIES, int(host.generator(job.seed, host.EVALUATION, 3).integers(2**63)))
    steps: list[Walked] = []
    for _ in range(KICKED_STEPS):
        here = simulator.observe()
        action = np.clip(loop.act(state, here), -1.0, 1.0)
        steps.append(Walked(here, action, simulator.step(action)))
    simulator.close()
    all_steps = _joined(steps)
    result = all_steps.result
    ended = (result.terminated | result.truncated).reshape(KICKED_STEPS, COPIES)
    standing = np.cumsum(ended, 0) - ended == 0  # an episode that follows upon a fall was not kicked
    adjusted, _, why = reward_fn.explain(all_steps, result.reward)
    sigma_m = reward_fn.doubt(result.observation)
    columns = (sigma_m, why.sigma_h, why.weight, result.reward, adjusted, result.true_reward)
    several = np.stack([np.broadcast_to(np.asarray(c, float), sigma_m.shape) for c in columns], -1)
    several = several.reshape(KICKED_STEPS, COPIES, len(columns))
    means = (several * standing[..., None]).sum(1) / np.maximum(standing.sum(1), 1)[:, None]
    return np.column_stack([standing.mean(1), means])
