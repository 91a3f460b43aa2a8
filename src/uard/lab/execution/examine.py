"""What an agent trained in MuJoCo makes of a reward that is distorted after training (G12-G15), and what sigma_m knows.

The paper defines neither the distortion nor the "confidence-adjusted reward". These definitions are OURS, those of the
grids (``uard.replication.distortion``) where they can be:

* The trained agent walks 1000 steps with its most likely actions. In three windows an adversary adds 4, the regions'
  bonus, to the observed reward of every step; the raters tell the truth as they see it.
* The confidence-adjusted reward is what the agent would learn from: the mitigation's; for SUNRISE times the weight of
  its backup; for EDAC less the critics' pessimism, mean less lowest.
* The advantage of the agent's action over a random one (G13) is that of one step ahead, r + gamma V(s'), on the learned
  critics, with the reward of the random action's step raised by epsilon and then filtered.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from uard.envs.locomotion.physics import Moved, Physics
from uard.method import calibration
from uard.method.mitigations import Evidence, Feedback, RatedReward, RewardDiscounting

STEPS = 1000
WINDOWS = ((200, 220), (400, 420), (750, 770))
BONUS = 4.0
EVERY = 10  # steps between two that are tried with a random action, too
EPSILONS = np.linspace(0.0, 8.0, 17)
THROWN = 1.0  # m, rad, m/s or rad/s, of one coordinate of a state that was never visited
WORST = 0.75  # errors above this quantile are what sigma_m is to warn of

CAUTION = RatedReward("bound")  # a static pessimist: mean - sd over the ratings and the observed reward

# Columns of what is found.
TRACE = ("observed", "adjusted", "caution", "lam", "true")
PERTURBED = ("filtered", "raw", "sign_kept_filtered", "sign_kept_raw")
WARNING = ("auroc_thrown", "auroc_error")
REACTION = ("activations", "believed", "lambda_inside", "lambda_outside")


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
    moved: Moved


def examine(job: Any, live: Any) -> dict[str, np.ndarray]:
    """Examine a trained agent.

    Args:
        job: The run, a ``training.host.Job``.
        live: Its last state.

    Returns:
        ``trace`` (STEPS, len(TRACE)) of the distorted walk; ``perturbed`` (len(EPSILONS), len(PERTURBED)): means over
        the states in which the agent's action is the better one; ``warning`` (len(WARNING),): chance that sigma_m is
        larger at a state thrown off by ``THROWN`` than at a visited one, and where the value is among the most wrong
        quarter than elsewhere.
    """
    judge = _Judge(job, live)
    own, rival = _walk(job, live, judge.loop)
    observed = own.moved.reward + BONUS * inside()
    adjusted, caution, lam = judge(own, observed)
    trace = np.column_stack([observed, adjusted, caution, lam, own.moved.true])
    found = {"trace": trace, "perturbed": _perturbed(judge, own, rival), "warning": _warning(judge, own)}
    return {name: value.astype(np.float32) for name, value in found.items()}


def _walk(job: Any, live: Any, loop: Any) -> tuple[Walked, Walked]:
    """Return the agent's steps, and what a random action would have led to in every ``EVERY``-th of its states."""
    from uard.training.host import loop as host

    random = host.generator(job.seed, host.EVALUATION, 1)
    physics = Physics(job.spec, 1, int(random.integers(2**63)))
    own: list[Walked] = []
    rival: list[Walked] = []
    for t in range(STEPS):
        here = physics.observe()
        if t % EVERY == 0:
            saved = physics.save()
            other = random.uniform(-1.0, 1.0, (1, job.spec.actions))
            rival.append(Walked(here, other, physics.step(other)))
            physics.load(saved)
        action = np.clip(loop.act(live, here), -1.0, 1.0)
        own.append(Walked(here, action, physics.step(action)))
    return _joined(own), _joined(rival)


def _joined(steps: list[Walked]) -> Walked:
    observation, action, moved = zip(*steps, strict=True)
    return Walked(
        np.concatenate(observation), np.concatenate(action), Moved(*map(np.concatenate, zip(*moved, strict=True)))
    )


class _Judge:
    """The filter of a trained agent, by itself."""

    def __init__(self, job: Any, live: Any):
        import jax

        from uard.training.feedback import transition_model as transitions
        from uard.training.host import loop as host

        self.job, self.live, self.loop = job, live, host.bind(job)
        self.raters = job.fixed.raters
        self.read = jax.jit(partial(transitions.read, job.feedback, raters=self.raters))
        self.usual: dict[Any, Any] = {job.mitigation: ()}
        if job.listens:
            measure = jax.jit(transitions.usual, static_argnames=("mitigation", "spec", "raters"))
            kept, seen = live.reservoir.inputs, live.reservoir.seen[0]
            for m in (job.mitigation, CAUTION):
                found = measure(m, job.feedback, live.model, kept, seen, raters=self.raters)
                self.usual[m] = jax.tree.map(lambda x: np.asarray(x, float), found)

    def opinions(self, observations: np.ndarray) -> np.ndarray:
        """Return all critics' values, (N, B)."""
        return np.asarray(self.loop.values(self.live, observations), float)

    def value(self, observations: np.ndarray) -> np.ndarray:
        """Return their mean, (B,)."""
        return self.opinions(observations).mean(0)

    def doubt(self, observations: np.ndarray) -> np.ndarray:
        """Return sigma_m of states, (B,)."""
        opinions = self.opinions(observations)
        return opinions.std(0, ddof=1) if len(opinions) > 1 else np.zeros(opinions.shape[1])

    def __call__(self, steps: Walked, reward: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what the agent and a static pessimist would learn from steps so rewarded, and lambda_t; (B,) each."""
        from uard.training.feedback import transition_model as transitions

        agent, mitigation, moved = self.job.agent, self.job.mitigation, steps.moved
        ahead = np.where(moved.terminated, 0.0, agent.gamma * self.doubt(moved.observation))
        evidence = Evidence(reward, ahead, self._feedback(steps, reward))
        usual = {m: transitions.expecting(u, evidence.feedback) for m, u in self.usual.items()}
        adjusted = np.asarray(mitigation.signal(evidence, usual[mitigation]).reward, float)
        opinions = self.opinions(steps.observation)
        if heat := getattr(agent, "backup_temperature", 0.0):
            adjusted = adjusted * backup_trust(opinions.std(0, ddof=1), heat)
        elif getattr(agent, "diversity", 0.0):
            adjusted = adjusted - (opinions.mean(0) - opinions.min(0))
        caution, lam = reward, np.zeros(len(reward))
        if self.job.listens:
            caution = np.asarray(CAUTION.signal(evidence, usual[CAUTION]).reward)
        if isinstance(mitigation, RewardDiscounting):
            lam = lam + np.asarray(mitigation.explain(evidence, usual[mitigation]).lam)
        return adjusted, caution, lam

    def _feedback(self, steps: Walked, reward: np.ndarray) -> Feedback:
        from uard.training.feedback import transition_model as transitions

        if not self.job.listens:
            return Feedback._make([*np.zeros((5, len(reward))), np.float64(self.raters)])
        told = transitions.features(steps.observation, steps.action, steps.moved.observation, reward)
        return Feedback._make([np.asarray(x, float) for x in self.read(self.live.model, told.astype(np.float32))])


def _perturbed(judge: _Judge, own: Walked, rival: Walked) -> np.ndarray:
    chosen = Walked(own.observation[::EVERY], own.action[::EVERY], Moved(*(x[::EVERY] for x in own.moved)))
    ahead, ahead_of_rival = (
        np.where(w.moved.terminated, 0.0, judge.job.agent.gamma * judge.value(w.moved.observation))
        for w in (chosen, rival)
    )
    raised = rival.moved.reward + EPSILONS[:, None]
    filtered = judge(chosen, chosen.moved.reward)[0] - np.array([judge(rival, r)[0] for r in raised])
    columns = []
    for gap in (filtered, chosen.moved.reward - raised):
        gaps = (gap + ahead - ahead_of_rival)[:, gap[0] + ahead - ahead_of_rival > 0]
        none = np.zeros(len(EPSILONS))
        columns.append((gaps.mean(1), (gaps > 0).mean(1)) if gaps.size else (none, none))
    (gap_filtered, kept_filtered), (gap_raw, kept_raw) = columns
    return np.column_stack([gap_filtered, gap_raw, kept_filtered, kept_raw])


def _warning(judge: _Judge, own: Walked) -> np.ndarray:
    from uard.training.host import loop as host

    random = host.generator(judge.job.seed, host.EVALUATION, 2)
    rows, width = own.observation.shape
    thrown = own.observation.copy()
    thrown[np.arange(rows), random.integers(width, size=rows)] += THROWN * random.choice([-1.0, 1.0], rows)
    sigma = judge.doubt(own.observation)
    new = calibration.auroc(np.concatenate([sigma, judge.doubt(thrown)]), np.arange(2 * rows) >= rows)
    reward, moved = judge(own, own.moved.reward)[0], own.moved
    after, value = judge.value(moved.observation), judge.value(own.observation)
    earned, following = np.zeros(rows), after[-1]
    for t in range(rows - 1, -1, -1):
        following = 0.0 if moved.terminated[t] else after[t] if moved.truncated[t] else following
        following = earned[t] = reward[t] + judge.job.agent.gamma * following
    error = np.abs(value - earned - np.median(value - earned))
    wrong = error > np.quantile(error, WORST)
    return np.array([new, calibration.auroc(sigma, wrong) if wrong.any() else 0.5])
