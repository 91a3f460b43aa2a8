"""Who acts where, as ``uard collect record`` is told: an environment by its name, a policy by its source."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import closing
from typing import TYPE_CHECKING, Any, NamedTuple

from uard import InvalidValueError, _checks

if TYPE_CHECKING:
    import gymnasium
    import numpy as np

RANDOM, SB3, STORE = "random", "sb3", "uard"
_GYMNASIUM = {"CartPole": "CartPole-v1", "Acrobot": "Acrobot-v1"}  # of our names, those that are Gymnasium's own
_SHOWN = 8  # cells of a store that a message names


class Acting(NamedTuple):
    """A policy.

    Attributes:
        policy: From an observation to an action, or ``random``.
        name: What its clips are called.
    """

    policy: Callable[[Any], Any] | str
    name: str


def environment(name: str, settings: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    """Return an environment that draws pictures, by an id of Gymnasium's or a name of ``uard run``'s.

    Raises:
        InvalidValueError: there is none of that name, it has no such settings, or it draws no pictures.
    """
    from uard.envs import gym, names

    try:
        if name in gym.IDS.values():
            return gym.make(name, render_mode="rgb_array", **settings)
        return _of_gymnasium(_GYMNASIUM.get(name, name), settings)
    except InvalidValueError as error:
        if error.field != "render_mode":
            raise
        allowed = "one that draws pictures (render_mode 'rgb_array'), and this one does not"
        raise InvalidValueError("environment", name, allowed) from None
    except TypeError as error:
        raise InvalidValueError("environment", name, f"made with settings that it has ({error})") from None
    except LookupError as error:
        if "/" not in name and "-v" not in name:
            raise _checks.UnknownNameError("environment", name, names.KINDS) from None
        raise InvalidValueError("environment", name, f"the id of a Gymnasium environment ({error})") from None


def _of_gymnasium(name: str, settings: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    import importlib

    import gymnasium

    module, colon, known = name.rpartition(":")
    try:
        if colon:
            importlib.import_module(module)
        return gymnasium.make(known, render_mode="rgb_array", **settings)
    except (gymnasium.error.UnregisteredEnv, gymnasium.error.NamespaceNotFound, gymnasium.error.NameNotFound) as error:
        raise LookupError(str(error)) from None
    except (gymnasium.error.Error, ImportError, AttributeError, ValueError) as error:
        if isinstance(error, InvalidValueError):
            raise
        raise InvalidValueError("environment", name, f"one that can be made here ({error})") from None


def policy(text: str, env: gymnasium.Env[Any, Any]) -> Acting:
    """Return a policy: ``random``, ``sb3:FILE``, or ``uard:STORE`` with ``@CELL`` or ``@CELL:SEED`` behind it.

    Raises:
        InvalidValueError: there is none such, or it cannot act in the environment.
    """
    source, _, where = text.partition(":")
    if text == RANDOM:
        return Acting(RANDOM, RANDOM)
    if source == SB3 and where:
        return _of_sb3(where, env)
    if source == STORE and where:
        return _of_store(where, env)
    raise InvalidValueError("--policy", text, "random, sb3:FILE or uard:STORE")


def _of_sb3(path: str, env: gymnasium.Env[Any, Any]) -> Acting:
    """Load an agent of Stable-Baselines3. Its file is executed, for it holds pickled objects."""
    import json
    import zipfile

    option = "--policy"
    try:
        with zipfile.ZipFile(path) as file:
            settings = json.loads(file.read("data"))
    except OSError as error:
        raise InvalidValueError(option, path, f"a file that can be read ({error.strerror or error})") from None
    except (zipfile.BadZipFile, KeyError, ValueError):
        raise InvalidValueError(option, path, "a zip file that Stable-Baselines3's save() has written") from None
    try:
        import stable_baselines3
    except ModuleNotFoundError:
        allowed = "random, or first: pip install 'uard[sb3]' (Stable-Baselines3 reads this file)"
        raise InvalidValueError(option, path, allowed) from None
    name = _algorithm(settings)
    if name is None:
        raise InvalidValueError(option, path, "an agent of PPO, A2C, DQN, SAC or TD3")
    try:
        agent = getattr(stable_baselines3, name).load(path, device="cpu")
    except Exception as error:  # of whatever is in the file
        allowed = f"an agent that Stable-Baselines3 {stable_baselines3.__version__} can load ({error})"
        raise InvalidValueError(option, path, allowed) from error
    for field in ("observation_space", "action_space"):
        theirs, here = getattr(agent, field), getattr(env, field)
        if (theirs.shape, type(theirs), getattr(theirs, "n", 0)) != (here.shape, type(here), getattr(here, "n", 0)):
            raise InvalidValueError(f"{field} of {path}", theirs, f"{here}, as the environment's")

    def act(observation: Any) -> Any:
        return agent.predict(observation, deterministic=True)[0]

    stem = os.path.splitext(os.path.basename(path))[0]
    return Acting(act, f"{name} {stem}")


def _algorithm(settings: Any) -> str | None:
    """Return which algorithm's settings these are, without running anything of the file."""
    if not isinstance(settings, Mapping):
        return None
    if "policy_delay" in settings:
        return "TD3"
    if "target_entropy" in settings and "top_quantiles_to_drop_per_net" not in settings:
        return "SAC"
    if "exploration_fraction" in settings:
        return "DQN"
    if "clip_range" in settings and "n_epochs" in settings:
        return "PPO"
    if "gae_lambda" in settings and "cg_max_steps" not in settings:
        return "A2C"
    return None


def _of_store(where: str, env: gymnasium.Env[Any, Any]) -> Acting:
    """Return the agent of a finished run: results keep which states it visits without exploring, and no values."""
    from uard.lab.execution.store import Store
    from uard.lab.views.compare import title

    path, key, seed = _parts(where)
    if not os.path.isfile(path):
        allowed = "a result store that is there; `uard run --store` and `uard reproduce` make one"
        raise InvalidValueError("--policy", f"{STORE}:{where}", allowed)
    problem = getattr(env.unwrapped, "problem", None)
    if getattr(problem, "kind", None) != "tables":
        allowed = (
            "random or sb3:FILE here: results keep how an agent acts only in worlds of tables, such as TrapGrid, and "
            "of other agents no networks"
        )
        raise InvalidValueError("--policy", f"{STORE}:{where}", allowed)
    with closing(Store(path, readonly=True)) as store:
        cells = {k: c for k, c in store.configs().items() if c["environment"] == _config(problem)}
        matching = {k: c for k, c in cells.items() if k.startswith(key)}
        if len(matching) != 1:
            shown = "; ".join(f"@{k[:8]} ({title(c)})" for k, c in list((matching or cells).items())[:_SHOWN])
            allowed = f"{STORE}:STORE@CELL, with the beginning of one cell's key: {shown}"
            if not cells:
                allowed = f"a store with a finished run in this environment, {problem}"
            raise InvalidValueError("--policy", f"{STORE}:{where}", allowed)
        ((key, config),) = matching.items()
        seeds, _ = store.stored(key)
    if not seeds or (seed is not None and seed not in seeds):
        raise InvalidValueError("--policy", f"{STORE}:{where}", f"with a seed that is finished: {sorted(seeds)}")
    from uard.lab.result import Result

    seed = min(seeds) if seed is None else seed
    told = f"{config['mitigation']['type']} {key[:8]} seed {seed}"
    return Acting(_along(Result.unpack(seeds[seed][0]).path, problem, f"{STORE}:{where}"), told)


def _parts(where: str) -> tuple[str, str, int | None]:
    """Return the file, the beginning of a cell's key, and the seed if there is one."""
    path, sign, rest = where.rpartition("@")
    if not sign or os.path.isfile(where):
        return where, "", None
    key, colon, seed = rest.partition(":")
    if colon and not seed.isdecimal():
        raise InvalidValueError("--policy", f"{STORE}:{where}", "uard:STORE@CELL:SEED, with a seed that is a number")
    return path, key, int(seed) if colon else None


def _config(problem: Any) -> Any:
    """Return an environment as a cell's configuration has it."""
    import json

    from uard.lab.cell import Cell

    return json.loads(json.dumps(Cell(problem).config()["environment"]))


def _along(path: np.ndarray, problem: Any, text: str) -> Callable[[Any], int]:
    """Return the policy that goes along a path of states.

    Raises:
        InvalidValueError: the path does not say what the agent does.
    """
    import numpy as np

    task = problem.task(np.float64)
    next_state, reward = np.asarray(task.next_state), np.asarray(task.reward)
    if len(set(np.atleast_1d(task.start).tolist())) > 1:
        allowed = "random or sb3:FILE here: episodes begin in several states, and results keep the path from one"
        raise InvalidValueError("--policy", text, allowed)
    actions: dict[int, int] = {}
    for state, after in zip(path[:-1].tolist(), path[1:].tolist(), strict=True):
        possible = np.flatnonzero(next_state[state] == after)
        if not len(possible) or len(set(reward[state, possible].tolist())) > 1:
            allowed = f"another run: its path does not say what it does in state {state}"
            raise InvalidValueError("--policy", text, allowed)
        if actions.setdefault(state, int(possible[0])) != possible[0]:
            allowed = f"another run: in state {state} it does not always do the same"
            raise InvalidValueError("--policy", text, allowed)
    if not actions:
        raise InvalidValueError("--policy", text, "a run whose result has the path of the trained agent")

    def act(observation: Any) -> int:
        state = int(observation)
        if state not in actions:
            allowed = f"one of those on the path of the trained agent, which is all that {text} keeps of it"
            raise InvalidValueError("state", state, allowed)
        return actions[state]

    return act
