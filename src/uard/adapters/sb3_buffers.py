"""Stable-Baselines3's buffers, which filter when rewards are learned from: a batch or a rollout at a time.

A replay buffer remembers what it found the last time: of steps of which nothing new is known, rewards are looked up. A
rollout buffer is told by the callback what raters say, which Stable-Baselines3 does not hand to it.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import gymnasium
import numpy as np

from uard import _checks
from uard.adapters.sb3_critics import CriticDisagreement
from uard.adapters.steps import (
    KeyFn,
    RatingsFn,
    SigmaFn,
    Steps,
    arrays_of,
    batch_of,
    natural_key,
    refuse_filtered,
    rows_of,
    with_row,
)
from uard.method.abstention import Abstention
from uard.method.mitigations import Mitigation
from uard.ratings.aggregate import aggregate
from uard.ratings.stream import MAX_KEYS, MAX_RATERS, Filtered, RewardStream

try:
    from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"uard.adapters.sb3 needs Stable-Baselines3: pip install 'uard[sb3]' ({error})", name=error.name
    ) from error

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, Integer
    from stable_baselines3.common.vec_env import VecNormalize

FEW = 2  # ratings of a state-action: up to so many, a new one counts in the next batch
DRAWS = 32  # batches: what else is new counts in one of so many
WAIT = 64  # steps of all environments that wait at most to be taken in
SOON = 64  # rated steps without keys: up to so many, a new one is taken in before the next batch
WHOLE = 16_384  # steps without keys: if there are no more, all are judged when the panel was measured
SURELY_FITTING = 1e38  # of rewards, in single precision
MOST_PAIRS = 8192  # different pairs of state-action and reward; with more, every batch is judged


def ratings_in(infos: list[dict[str, Any]]) -> Float[np.ndarray, "B K"] | None:
    """Return the ratings in ``infos``, NaN where one is missing; None if there are none.

    Examples:
        >>> ratings_in([{"ratings": [1.0, None]}, {}]).tolist()
        [[1.0, nan], [nan, nan]]
    """
    return rows_of({i: x["ratings"] for i, x in enumerate(infos) if x.get("ratings") is not None}, len(infos))


def refuse_filtered_infos(infos: list[dict[str, Any]]) -> None:
    """Refuse steps that have been filtered already.

    Examples:
        >>> refuse_filtered_infos([{"ratings": [1.0]}])
    """
    for i, info in enumerate(infos):
        if "raw_reward" in info:
            refuse_filtered(info, f"infos[{i}]['raw_reward']")


def refuse_no_array(space: Any) -> None:
    """Refuse observations that are no arrays.

    Examples:
        >>> refuse_no_array(gymnasium.spaces.Discrete(2))
    """
    if isinstance(space, gymnasium.spaces.Dict | gymnasium.spaces.Tuple):
        allowed = "of arrays: put gymnasium's FlattenObservation around the environment, or use ReliabilityVecEnv"
        raise _checks.InvalidValueError("observation_space", cast("object", space), allowed)


def stacked(steps: list[Float[np.ndarray, "E any"] | None], count: int) -> Float[np.ndarray, "n K"] | None:
    """Return the ratings of several steps of ``count`` environments in one array; None if there are none.

    Examples:
        >>> stacked([np.ones((1, 2)), None], 1).tolist()
        [[1.0, 1.0], [nan, nan]]
    """
    widths = {0 if x is None else x.shape[1] for x in steps}
    if widths == {0}:
        return None
    if len(widths) == 1:
        return np.concatenate([x for x in steps if x is not None])
    found = np.full((len(steps), count, max(widths)), np.nan)
    for i, x in enumerate(steps):
        if x is not None:
            found[i, :, : x.shape[1]] = x
    return found.reshape(len(steps) * count, -1)


class _Pairs:
    """What steps with keys are worth: state-actions with observed rewards; alike steps are judged once.

    Attributes:
        numbers: Of each step's pair.
        values: Filtered rewards of the pairs, in single precision.
    """

    def __init__(self, size: tuple[int, int]):
        """Start without any, for so many steps of so many environments."""
        self.numbers = np.zeros(size, np.int64)
        self.values = np.zeros(0, np.float32)
        self._known: dict[tuple[Hashable, float], int] = {}
        self._slots, self._rewards, self._counts = np.zeros(0, np.int64), np.zeros(0), np.zeros(0)
        self._by = -1  # the statistics of the panel by which all were judged

    def put(self, place: int, keys: Sequence[Hashable], rewards: Sequence[float]) -> bool:
        """Number one step of all environments; say whether a pair is new."""
        new = False
        for i, pair in enumerate(zip(keys, rewards, strict=True)):
            number = self._known.get(pair)
            if number is None:
                new, number = True, len(self._known)
                self._known[pair] = number
            self.numbers[place, i] = number
        return new

    def __len__(self) -> int:
        """How many there are."""
        return len(self._known)

    def placed(self, place: int, slots: Int[np.ndarray, " E"], rewards: Sequence[float]) -> None:
        """Say where what is known of a step's state-actions is kept."""
        more = len(self._known) - len(self._slots)
        if more > 0:
            more = max(64, more, len(self._slots))
            self._slots, self._rewards = np.pad(self._slots, (0, more)), np.pad(self._rewards, (0, more))
            self._counts = np.pad(self._counts, (0, more), constant_values=-1.0)  # which no state-action has
            self.values = np.pad(self.values, (0, more))
        numbers = self.numbers[place]
        self._slots[numbers], self._rewards[numbers] = slots, rewards

    def judge(self, stream: RewardStream) -> None:
        """Judge all pairs of which something new is known."""
        measurement, size = stream.measurement(True), len(self._known)
        slots = self._slots[:size]
        counts = stream.counts(slots)
        which = np.arange(size) if measurement != self._by else (counts != self._counts[:size]).nonzero()[0]
        if len(which):
            out = stream.filter(self._rewards[which], stream.known(slots[which]), keyed=True)
            self.values[which] = _checks.fitting("filtered reward", out.reward, np.float32)
        self._counts[:size], self._by = counts, measurement

    def forget(self) -> None:
        """Judge everything anew the next time."""
        self._by = -1


class _Singles:
    """Which steps without keys were judged; their filtered rewards are in the buffer.

    Attributes:
        open: Whether a step's filtered reward depends on what critics say of it, too.
        filled: How many steps there are.
    """

    def __init__(self, size: int, filled: int):
        """Start with none judged of ``filled`` steps, in a buffer of ``size``."""
        self._by = np.full(size, -1, np.int64)  # the statistics of the panel by which each was judged
        self._whole, self._new, self.filled = -1, list[int](), filled
        self.open = np.ones(size, bool)

    def put(self, first: int, count: int) -> None:
        """Say that there are new steps in some places, one after the other."""
        places = range(first, first + count)
        self._by[first : first + count] = -1
        self._new += places
        self.filled = max(self.filled, places.stop)

    def drawn(self, places: Integer[np.ndarray, " n"]) -> bool:
        """Whether a step is among them that was added since others were judged."""
        return bool(self._new) and bool((self._by[places] < 0).any())

    def unjudged(self, places: Integer[np.ndarray, " n"], measurement: int) -> Int[np.ndarray, " m"]:
        """Return the places of steps to be judged before these are learned from; they then count as judged."""
        if self.filled <= WHOLE:
            old = self._by[: self.filled] != measurement
            which = old.nonzero()[0]
        else:
            which = np.unique(np.concatenate([places[self._by[places] != measurement], self._new[-WHOLE:]]))
            which = which.astype(np.int64)
        self._by[which], self._whole, self._new = measurement, measurement, []
        return which

    def stale(self, measurement: int) -> bool:
        """Whether steps must be looked at one by one: the panel was measured since, or there are too many."""
        return self._whole != measurement or self.filled > WHOLE

    def forget(self) -> None:
        """Judge everything anew the next time."""
        self._by[:] = self._whole = -1


class ReliabilityReplayBuffer(ReplayBuffer):
    """Keeps raw rewards and their ratings, and filters whenever it is sampled.

    Examples:
        >>> from gymnasium.spaces import Discrete
        >>> buffer = ReliabilityReplayBuffer(8, Discrete(9), Discrete(4))
        >>> state, action, reward, done = (np.array([x]) for x in (7, 2, 4.0, False))
        >>> buffer.add(state, state, action, reward, done, [{"ratings": [-1.0, 2.0, 1.0]}])
        >>> buffer.sample(5).rewards.shape, buffer.latest.raw.tolist()
        (torch.Size([5, 1]), [4.0, 4.0, 4.0, 4.0, 4.0])

    For ``replay_buffer_class=`` of DQN, SAC, TD3 and DDPG with one-step targets and observations that are arrays; the
    options go into ``replay_buffer_kwargs``. ``save_replay_buffer`` keeps all of it.

    What raters said later counts for all steps of the same state-action: of the first two ratings of a state-action in
    the next batch that is drawn, of others at the latest in the 32nd.

    Attributes:
        steps: What filters.
    """

    def __init__(
        self,
        *arguments: Any,
        mitigation: Mitigation | None = None,
        ratings: RatingsFn | None = None,
        sigma_m: SigmaFn | None = None,
        key: KeyFn | None = None,
        **options: Any,
    ):
        """Build an empty buffer; see ``ReplayBuffer`` and ``uard.adapters.gymnasium.ReliabilityWrapper``.

        Raises:
            InvalidValueError: for observations that are no arrays.
        """
        refuse_no_array(arguments[1] if len(arguments) > 1 else options.get("observation_space"))
        cast("Any", super()).__init__(*arguments, **options)
        spaces: Any = self
        key = key or natural_key(spaces.observation_space, spaces.action_space)
        # As many keys as steps: what a step in the buffer points to is never forgotten.
        stream = RewardStream(mitigation, max_keys=max(MAX_KEYS, self.buffer_size * self.n_envs))
        self._steps = Steps(stream, ratings, sigma_m, key)
        self._waiting: list[_Waiting] = []
        self._soon = False  # whether what waits counts in the next batch
        size = self.buffer_size, self.n_envs
        self._raw = np.zeros(size)
        # With keys the place of what is known of a step's state-action, without keys the step's own ratings.
        self._slots = np.zeros(size if key else (0, 0), np.int64)
        self._ratings = np.full((0, 0, 1) if key else (*size, 1), np.nan)
        self._drawn: Integer[np.ndarray, " batch"] | None = None
        self._latest: Filtered | None = None
        self._start_judging(_Pairs(size) if key else None)

    def _start_judging(self, pairs: _Pairs | None) -> None:
        """Forget what was judged; ``pairs`` are those of steps with keys, None where each is judged when drawn."""
        keyed, size = self._steps.key is not None, 0 if self._steps.key else self.buffer_size * self.n_envs
        self._pairs, self._draws = pairs, 0
        self._rated: tuple[int, int, int] | None = None  # what was known when all was judged
        self._singles = None if keyed else _Singles(size, size if self.full else self.pos * self.n_envs)
        self._judge = self._steps.stream, self._steps.stream.mitigation

    @property
    def steps(self) -> Steps:
        """What filters; it knows all that was added."""
        self._take_in()
        return self._steps

    def __setstate__(self, kept: dict[str, Any]) -> None:
        """Take what was pickled, also by versions that judged every batch."""
        mine = vars(self)
        mine.update(kept)
        if "_singles" not in kept:
            mine.pop("latest", None)
            self._steps, self._waiting, self._soon = mine.pop("steps"), [], False
            self._drawn = self._latest = None
            self._start_judging(None)

    @property
    def latest(self) -> Filtered | None:
        """The rewards that were sampled last, None before the first."""
        if self._latest is None and self._drawn is not None:
            self._take_in()
            critics, asked = self._steps.sigma_m, None
            if isinstance(critics, CriticDisagreement):
                drawn = self.observations[self._drawn], self.actions[self._drawn]
                asked = critics.of_kept(drawn[0].reshape(-1, *self.obs_shape), drawn[1].reshape(-1, self.action_dim))
            self._latest = self._filtered(self._drawn, asked)
        return self._latest

    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: list[dict[str, Any]]) -> None:
        """Store one step of every environment, with the ratings in its ``info``.

        Raises:
            InvalidValueError: for a reward or ratings that no training should be fed, or a reward that has been
                filtered already; names the environment.
        """
        refuse_filtered_infos(infos)
        obs, action = np.asarray(obs), np.asarray(action)
        steps, plain = self._steps, self._plain(reward, infos)
        states = acts = None
        if steps.reads_steps:
            states, acts = obs.reshape(self.n_envs, *self.obs_shape), action.reshape(self.n_envs, self.action_dim)
            if steps.key is not None:  # which is given numbers, where states or actions are numbers
                spaces = cast("Any", self)
                states, acts = _numbers_in(spaces.observation_space, states), _numbers_in(spaces.action_space, acts)
        keys = steps.keys(states, acts, self.n_envs)
        if plain is not None and self._may_wait(keys):
            step = _Waiting(self.pos, plain[0], plain[1], keys)
            self._waiting.append(step)
            if self._pairs is not None and keys is not None and self._pairs.put(self.pos, keys, plain[0]):
                self._soon = True
            if steps.key is None:
                self._store(step)
        else:  # somebody must say what is wrong with it before it is stored
            rewards = _checks.as_numpy("reward", reward).reshape(-1)
            _checks.fitting("reward", rewards, self.rewards.dtype)
            ratings = steps.ratings_of(states, acts, next_obs, rewards, ratings_in(infos))
            self._take_in()
            slots = steps.stream.observe(rewards, ratings, keys).slots
            values = rewards.tolist()
            step = _Waiting(self.pos, values, None if ratings is None else ratings.tolist(), keys)
            if self._pairs is not None and keys is not None:
                self._pairs.put(self.pos, keys, values)
            self._store(step)
            self._placed(step, slots)
            self._soon = True
        super().add(obs, next_obs, action, reward, done, infos)
        if self._singles is not None:
            self._singles.put(step.place * self.n_envs, self.n_envs)
        if len(self._waiting) >= WAIT:
            self._take_in()

    def _plain(self, reward: Any, infos: list[dict[str, Any]]) -> tuple[list[float], list[Any] | None] | None:
        """Return rewards and ratings as lists if there is nothing special about them; else somebody must look.

        In Python, because a few numbers every step are not worth NumPy's while.
        """
        if self._steps.ratings is not None:
            return None
        rewards = plain_floats(reward, SURELY_FITTING)
        if rewards is None:
            return None
        found: list[Any] = []
        for info in infos:
            given = info.get("ratings")
            row = None if given is None else plain_floats(given, _checks.LARGEST, missing=True)
            if row is None and given is not None:
                return None
            found.append(row)
        return rewards, found if any(row is not None for row in found) else None

    def _may_wait(self, keys: list[Hashable] | None) -> bool:
        """Whether steps of these keys may wait to be taken in; sets whether they must be before the next batch."""
        stream = self._steps.stream
        if keys is None:
            self._soon = self._soon or stream.rated < SOON
            return True
        try:
            self._soon = self._soon or self._pairs is None or any(stream.visits(key) < FEW for key in keys)
        except TypeError:  # a key that cannot be looked for
            return False
        return True

    def _take_in(self) -> None:
        """Have the stream take in the steps that wait."""
        waiting, self._waiting, self._soon = self._waiting, [], False
        if not waiting:
            return
        rewards = np.array([x for step in waiting for x in step.rewards])
        keys = None if waiting[0].keys is None else [key for step in waiting for key in step.keys or ()]
        nobody = [None] * self.n_envs
        rows = [row for step in waiting for row in step.ratings or nobody]
        slots = self._steps.stream.observe(rewards, _in_rows(rows), keys).slots
        for i, step in enumerate(waiting):
            if slots is not None:
                self._store(step)
                self._placed(step, slots[i * self.n_envs : (i + 1) * self.n_envs])
        if self._pairs is not None and len(self._pairs) > MOST_PAIRS:
            self._pairs = None

    def _store(self, step: _Waiting) -> None:
        """Keep raw rewards and, without keys, ratings of a step."""
        self._raw[step.place] = step.rewards
        if step.keys is None:
            self._keep_ratings(step.place, None if step.ratings is None else _in_rows(step.ratings))

    def _placed(self, step: _Waiting, slots: Int[np.ndarray, " E"] | None) -> None:
        """Remember where what is known of a step's state-actions is kept."""
        if slots is not None:
            self._slots[step.place] = slots
            if self._pairs is not None:
                self._pairs.placed(step.place, slots, step.rewards)

    def _keep_ratings(self, place: int, ratings: Float[np.ndarray, "E K"] | None) -> None:
        """Keep the ratings of one step of all E environments; None is no rating."""
        self._ratings[place] = np.nan
        if ratings is not None:
            more = ratings.shape[1] - self._ratings.shape[2]
            if more > 0:
                self._ratings = np.pad(self._ratings, ((0, 0), (0, 0), (0, more)), constant_values=np.nan)
            self._ratings[place, :, : ratings.shape[1]] = ratings

    def _get_samples(self, batch_inds: Integer[np.ndarray, " batch"], env: VecNormalize | None = None) -> Any:
        self._drawn, self._latest, sigma_m = batch_inds, None, self._steps.sigma_m
        self._draws += 1
        if self._soon or self._draws % DRAWS == 0:
            self._take_in()
        if sigma_m is None and (self._pairs is not None or self._singles is not None):
            self._judge_what_is_new(batch_inds)
            if self._pairs is not None:
                self.rewards[batch_inds] = self._pairs.values[self._pairs.numbers[batch_inds]]
            return super()._get_samples(batch_inds, env)
        if self._steps.key is not None:
            self._take_in()
        if isinstance(sigma_m, CriticDisagreement) and self.n_envs == 1:
            if self._singles is not None and _knows_where_it_reads(self._steps.stream.mitigation):
                return self._looked_up(batch_inds, env, sigma_m, self._singles)
            # The batch that will be learned from, so that its critics need not be asked again.
            batch: Any = super()._get_samples(batch_inds, env)
            self._latest = self._filtered(batch_inds, sigma_m.of_batch(batch.observations, batch.actions))
            learned = self._fitting(self._latest.reward)
            self.rewards[batch_inds] = learned
            normalised: Any = self._normalize_reward(learned, env)
            return batch._replace(rewards=self.to_torch(normalised))
        asked = None
        if sigma_m is not None:
            states = self._normalize_obs(self.observations[batch_inds].reshape(-1, *self.obs_shape), env)
            asked = self._steps.sigma_of(states, self.actions[batch_inds].reshape(-1, self.action_dim))
        self._latest = self._filtered(batch_inds, asked)
        self.rewards[batch_inds] = self._fitting(self._latest.reward)
        return super()._get_samples(batch_inds, env)

    def _looked_up(
        self,
        places: Integer[np.ndarray, " batch"],
        env: VecNormalize | None,
        critics: CriticDisagreement,
        kept: _Singles,
    ) -> Any:
        """Return a batch whose rewards are looked up, but for those that depend on what critics say now."""
        self._judge_what_is_new(places)
        batch: Any = super()._get_samples(places, env)
        if not (asks := kept.open[places]).any():
            return batch
        asked = critics.of_batch(batch.observations, batch.actions)
        self.rewards[places[asks]] = self._fitting(self._filtered(places[asks], asked[asks]).reward)
        return batch._replace(rewards=self.to_torch(self._normalize_reward(self.rewards[places], env)))

    def _judge_what_is_new(self, batch_inds: Integer[np.ndarray, " batch"]) -> None:
        """Filter rewards anew of which something else is known than when they were filtered."""
        stream, pairs, singles = self._steps.stream, self._pairs, self._singles
        if self._judge[0] is not stream or self._judge[1] is not stream.mitigation:  # somebody gave another one
            self._judge, self._rated = (stream, stream.mitigation), None
            for memory in (pairs, singles):
                if memory is not None:
                    memory.forget()
        measurement = stream.measurement(pairs is not None)
        if pairs is not None:
            if self._rated != (stream.rated, measurement, len(pairs)):
                pairs.judge(stream)
                self._rated = stream.rated, measurement, len(pairs)
        elif singles is not None:
            one = self.n_envs == 1
            places = batch_inds if one else (batch_inds[:, None] * self.n_envs + np.arange(self.n_envs)).reshape(-1)
            if singles.stale(measurement) or singles.drawn(places):
                which = singles.unjudged(places, measurement)
                if not len(which):
                    return
                ratings = self._ratings.reshape(-1, self._ratings.shape[2])[which]
                raw = self._raw.reshape(-1)[which]
                known = aggregate(ratings, raw, ddof=stream.ddof)
                out = stream.filter(raw, known, keyed=False)
                singles.open[which] = stream.reads_sigma_m(known, keyed=False)
                self.rewards.reshape(-1)[which] = _checks.fitting("filtered reward", out.reward, self.rewards.dtype)

    def _fitting(self, rewards: Float[np.ndarray, " n"]) -> Float[np.ndarray, "batch E"]:
        return _checks.fitting("filtered reward", rewards, self.rewards.dtype).reshape(-1, self.n_envs)

    def _filtered(self, batch_inds: Integer[np.ndarray, " batch"], sigma_m: Any) -> Filtered:
        """Filter the rewards of a batch, of all environments, by what is known now."""
        raw = self._raw[batch_inds].reshape(-1)
        if self._steps.key is not None:
            return self._filtered_at(raw, self._slots[batch_inds].reshape(-1), sigma_m)
        return self._filtered_by(raw, self._ratings[batch_inds].reshape(len(raw), -1), sigma_m)

    def _filtered_at(self, raw: Float[np.ndarray, " n"], slots: Int[np.ndarray, " n"], sigma_m: Any = None) -> Filtered:
        stream = self._steps.stream
        return stream.filter(raw, stream.known(slots), sigma_m, keyed=True)

    def _filtered_by(
        self, raw: Float[np.ndarray, " n"], ratings: Float[np.ndarray, "n K"], sigma_m: Any = None
    ) -> Filtered:
        stream = self._steps.stream
        return stream.filter(raw, aggregate(ratings, raw, ddof=stream.ddof), sigma_m, keyed=False)


def _knows_where_it_reads(mitigation: Mitigation) -> bool:
    return type(mitigation).reads_sigma_m is not Mitigation.reads_sigma_m


def plain_floats(values: Any, largest: float, missing: bool = False) -> list[float] | None:
    """Return a list of finite floats from a list or an array of one dimension, None if it is anything else.

    Examples:
        >>> plain_floats([1.0, None], 1e9, missing=True), plain_floats(np.array([1.0, 2.0]), 1.5)
        ([1.0, nan], None)

    Args:
        values: Numbers.
        largest: How large they may be.
        missing: Whether None and NaN stand for what is missing.
    """
    if type(values) is np.ndarray and values.ndim == 1 and values.dtype.char in "df":
        values = values.tolist()
    elif type(values) is not list:
        return None
    found: list[float] = []
    for value in cast("list[Any]", values):
        one = math.nan if missing and value is None else value
        if type(one) is not float or not (-largest <= one <= largest or (missing and one != one)):
            return None
        found.append(one)
    return found if 0 < len(found) <= MAX_RATERS else None


def _in_rows(rows: Sequence[Sequence[float] | None]) -> Float[np.ndarray, "n K"] | None:
    """Return the ratings of steps, each a row or None, in one array; NaN where one is missing."""
    widths = {0 if row is None else len(row) for row in rows}
    if widths == {0}:
        return None
    if len(widths) == 1:
        return np.array(rows, float)
    return np.array([[*(row or ()), *[math.nan] * (max(widths) - len(row or ()))] for row in rows])


class _Waiting(NamedTuple):
    """One step of all environments."""

    place: int
    rewards: Sequence[float]
    ratings: Sequence[Sequence[float] | None] | None
    keys: list[Hashable] | None


def _numbers_in(space: Any, batch: np.ndarray) -> np.ndarray:
    """Return a batch (B, ...) as (B,) where the space is one of numbers."""
    return batch.reshape(len(batch)) if isinstance(space, gymnasium.spaces.Discrete) else batch


class ReliabilityRolloutBuffer(RolloutBuffer):
    """Filters a whole rollout when it is complete: by all that raters have said until then, and in one go.

    Examples:
        >>> import uard.envs
        >>> from stable_baselines3 import PPO
        >>> from uard.adapters.sb3 import ReliabilityCallback
        >>> buffer = {"rollout_buffer_class": ReliabilityRolloutBuffer}
        >>> model = PPO("MlpPolicy", "uard/TrapGrid6-v0", n_steps=32, batch_size=32, **buffer)
        >>> model.learn(32, callback=ReliabilityCallback()).rollout_buffer.latest.raw.shape
        (32,)

    For ``rollout_buffer_class=`` of PPO, A2C and sb3-contrib's TRPO with observations that are arrays; the options go
    into ``rollout_buffer_kwargs``. It needs the ``ReliabilityCallback``, which tells it what raters say; without,
    training stops with an error. Environments give raw rewards, which must not be normalised.

    Attributes:
        steps: What filters; one for all environments.
        latest: The rewards of the latest rollout, step by step and within a step by environment; None before the first.
        episodes: Raw and filtered return of each episode that ended in the latest rollout.
    """

    def __init__(
        self,
        *arguments: Any,
        mitigation: Mitigation | None = None,
        ratings: RatingsFn | None = None,
        sigma_m: SigmaFn | None = None,
        key: KeyFn | None = None,
        abstention: Abstention | None = None,
        **options: Any,
    ):
        """Build an empty buffer; see ``RolloutBuffer`` and ``uard.adapters.gymnasium.ReliabilityWrapper``.

        Raises:
            InvalidValueError: for observations that are no arrays.
        """
        refuse_no_array(arguments[1] if len(arguments) > 1 else options.get("observation_space"))
        self._told: list[_Told] = []
        self.latest: Filtered | None = None
        self.episodes: list[tuple[float, float]] = []
        cast("Any", super()).__init__(*arguments, **options)
        spaces: Any = self
        key = key or natural_key(spaces.observation_space, spaces.action_space)
        stream = RewardStream(mitigation, abstention=abstention, max_keys=max(MAX_KEYS, self.buffer_size * self.n_envs))
        self.steps = Steps(stream, ratings, sigma_m, key)
        self._returns = np.zeros((2, self.n_envs))  # of the episodes that go on

    def reset(self) -> None:
        """Make room for a rollout; what raters said of one that was not completed is remembered."""
        if self._told:
            states, acts, following, rewards, found = self._joined()
            said = self.steps.ratings_of(states, acts, following, rewards, found)
            self.steps.stream.observe(rewards, said, self.steps.keys(states, acts, len(rewards)))
            self._told = []
        super().reset()

    def tell(
        self,
        observations: Any,
        actions: Any,
        next_observations: Any,
        rewards: Any,
        dones: Any,
        infos: list[dict[str, Any]],
    ) -> None:
        """Take in one step of all environments as they gave it; the callback calls this.

        Args:
            observations: What the actions were taken on, as the environments gave it; None if nobody looks at it.
            actions: As the environments got them.
            next_observations: What followed, after resets; None alike.
            rewards: (E,) raw rewards.
            dones: (E,) whether an episode ended.
            infos: With the ratings.

        Raises:
            InvalidValueError: for a reward or ratings that no training should be fed, or a reward that has been
                filtered already; names the environment.
        """
        refuse_filtered_infos(infos)
        # A copy: Stable-Baselines3 adds the value of what an episode's time limit cut off.
        raw = np.array(_checks.as_numpy("reward", rewards))
        _checks.moderate("reward", raw)
        seen = acted = reached = None
        if self.steps.reads_steps:
            space = cast("Any", self).observation_space
            seen, acted, reached = arrays_of(space, observations), np.array(actions), None
            if self.steps.ratings is not None:
                reached = arrays_of(space, next_observations)
                for i in np.flatnonzero(dones):
                    reached = with_row(reached, i, batch_of(space, infos[i]["terminal_observation"]))
        self._told.append(_Told(seen, acted, reached, raw, np.array(dones, bool), ratings_in(infos)))

    def _joined(self) -> tuple[Any, Any, Any, Float[np.ndarray, " n"], Float[np.ndarray, "n K"] | None]:
        """Return observations, actions, next observations, rewards and ratings of all steps that it was told of."""
        told = self._told
        steps = [
            None if told[0][i] is None else np.concatenate([cast("Any", one[i]) for one in told]) for i in range(3)
        ]
        rewards = np.concatenate([one.rewards for one in told])
        found = stacked([one.ratings for one in told], self.n_envs)
        return steps[0], steps[1], steps[2], rewards, found

    def compute_returns_and_advantage(self, last_values: Any, dones: np.ndarray) -> None:
        """Filter the rollout's rewards, and compute returns and advantages from them.

        Raises:
            InvalidValueError: nobody told it what raters say, or for rewards, ratings or a sigma_m that no training
                should be fed.
        """
        if len(self._told) != self.buffer_size:
            allowed = f"{self.buffer_size}: give learn(callback=ReliabilityCallback()), which tells it what raters say"
            raise _checks.InvalidValueError("steps that the buffer was told of", len(self._told), allowed)
        out = self.steps.filter(*self._joined())
        shape = self.rewards.shape
        raw, learned = out.raw.reshape(shape), out.reward.reshape(shape)
        bootstrap = self.rewards - raw  # the values of what time limits have cut off
        self.rewards = _checks.fitting("filtered reward", learned + bootstrap, self.rewards.dtype)
        self.episodes = self._ended(np.stack([raw, learned]))
        self.latest, self._told = out, []
        super().compute_returns_and_advantage(last_values, dones)

    def _ended(self, rewards: Float[np.ndarray, "2 n E"]) -> list[tuple[float, float]]:
        """Return raw and filtered return of the episodes that ended, and keep those of the others."""
        dones, found = np.array([one.dones for one in self._told]), list[tuple[int, float, float]]()
        for i in range(self.n_envs):
            ends = dones[:, i].nonzero()[0] + 1
            start = 0
            for end in ends.tolist():
                raw, learned = (self._returns[:, i] + rewards[:, start:end, i].sum(1)).tolist()
                found.append((end, raw, learned))
                self._returns[:, i], start = 0.0, end
            self._returns[:, i] += rewards[:, start:, i].sum(1)
        return [(raw, learned) for _, raw, learned in sorted(found)]


class _Told(NamedTuple):
    """One step of all environments."""

    observations: Any
    actions: Any
    next_observations: Any
    rewards: Float[np.ndarray, " E"]
    dones: Bool[np.ndarray, " E"]
    ratings: Float[np.ndarray, "E K"] | None
