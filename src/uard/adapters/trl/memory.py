"""What a reward has learned from completions, and the file that keeps it: numbers in JSON, nothing that is executed."""

from __future__ import annotations

import copy
import dataclasses
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from uard import _checks
from uard._support.files import replacing
from uard.judges import Moments, Scale
from uard.ratings.state import BROKEN, State
from uard.ratings.stream import RewardStream

FORMAT = {"format": "uard reward for TRL", "version": 1}
LARGEST_COUNT = 2**53  # numbers in a file; larger ones are no counts


@dataclass
class Tally:
    """Counts over all completions so far; those of each judge by its name.

    Examples:
        >>> Tally.of(["length", "clarity"]).missing
        {'length': 0, 'clarity': 0}

    Attributes:
        missing: How many each judge did not score.
        late: Batches for which each judge, or ``sigma_m``, was late, for a part of them perhaps.
        failed: Batches about which it raised, alike.
        absurd: Scores of each judge more than 100 of its standard deviations from its mean.
        compared: Groups of which each judge scored at least two completions.
        told_apart: Of these, how many it did not score all alike.
        completions: All of them.
        unscored: How many no judge scored.
        unchecked: How many were scored, but by fewer than two judges that tell completions apart.
        weight: Sum of the weights of the scored ones.
        widest: Largest sigma_h.
        discounted: Groups with a mean weight below 0.9.
        shifted: Of these, how many have nearly the same advantages without the discount.
        cancelled: How many have if a group's advantages are divided by their standard deviation; those shifted too.
    """

    missing: dict[str, int]
    late: dict[str, int]
    failed: dict[str, int]
    absurd: dict[str, int]
    compared: dict[str, int]
    told_apart: dict[str, int]
    completions: int = 0
    unscored: int = 0
    unchecked: int = 0
    weight: float = 0.0
    widest: float = 0.0
    discounted: int = 0
    shifted: int = 0
    cancelled: int = 0

    @classmethod
    def of(cls, judges: Iterable[str]) -> Tally:
        """Return the counts of judges before the first batch."""
        names = list(judges)
        missing, absurd, compared, told_apart = (dict.fromkeys(names, 0) for _ in range(4))
        late, failed = (dict.fromkeys([*names, "sigma_m"], 0) for _ in range(2))
        return cls(missing, late, failed, absurd, compared, told_apart)

    def never_tells_apart(self, judge: str) -> bool:
        """Whether a judge has scored groups of completions, and those of each group alike."""
        return self.compared[judge] > 0 and self.told_apart[judge] == 0


@dataclass
class Memory:
    """All that a reward has learned. Changed in place.

    Attributes:
        tally: Its counts.
        scales: Of each judge.
        members: The scale of all members of the ensemble.
        stream: The ratings, from which the mean disagreement comes.
    """

    tally: Tally
    scales: list[Scale]
    members: Scale
    stream: RewardStream

    def save(self, path: str | Path) -> None:
        """Write it to a file, which is whole at any time."""
        content = {
            **FORMAT,
            "judges": list(self.tally.missing),
            "tally": dataclasses.asdict(self.tally),
            "scales": [_of_scale(scale) for scale in [*self.scales, self.members]],
            "stream": _of_stream(self.stream),
        }
        with replacing(path) as file:
            file.write(json.dumps(content, allow_nan=False).encode())

    def load(self, path: str | Path) -> None:
        """Take up what ``save`` wrote; unchanged after an error.

        Raises:
            InvalidValueError: naming the file.
        """
        try:
            content = json.loads(Path(path).read_bytes(), parse_constant=_no_number)
            read = self._read(content)
        except (*BROKEN, LookupError, RecursionError) as error:
            what = f"one that a reward of judges {', '.join(self.tally.missing)} has saved, undamaged"
            why = f"{type(error).__name__}: {error}"
            raise _checks.InvalidValueError("file of a reward", str(path), f"{what} ({why})") from error
        vars(self).update(vars(read))

    def _read(self, content: Any) -> Memory:
        found = {name: content[name] for name in FORMAT}
        if found != FORMAT:
            raise _checks.InvalidValueError("format and version", found, str(FORMAT))
        names = list(self.tally.missing)
        if content["judges"] != names:
            raise _checks.InvalidValueError("judges", content["judges"], f"{names}, those of this reward")
        scales = [*self.scales, self.members]
        if len(content["scales"]) != len(scales):
            raise _checks.InvalidValueError("number of scales", len(content["scales"]), str(len(scales)))
        *of_judges, members = [_to_scale(scale, kept) for scale, kept in zip(scales, content["scales"], strict=True)]
        stream = _to_stream(self.stream, content["stream"])
        return Memory(_to_tally(names, content["tally"]), of_judges, members, stream)


def _no_number(text: str) -> None:
    raise _checks.InvalidValueError("number", text, "finite")


def _to_tally(names: list[str], kept: Any) -> Tally:
    new = Tally.of(names)
    counts: dict[str, Any] = dataclasses.asdict(new)
    if set(kept) != set(counts):
        raise _checks.InvalidValueError("tally", sorted(kept), f"the counts {', '.join(counts)}")
    for name, before in counts.items():
        if isinstance(before, dict):
            judges = list(cast("dict[str, int]", before))
            if list(kept[name]) != judges:
                raise _checks.InvalidValueError(f"tally.{name}", list(kept[name]), f"the counts of {judges}")
            for judge, count in kept[name].items():
                _checks.whole(f"tally.{name}[{judge!r}]", count, high=LARGEST_COUNT)
        elif isinstance(before, float):
            _checks.number(f"tally.{name}", kept[name], low=0)
        else:
            _checks.whole(f"tally.{name}", kept[name], high=LARGEST_COUNT)
    return Tally(**kept)


def _of_scale(scale: Scale) -> dict[str, Any]:
    return {**scale.known._asdict(), "lone": scale.lone, "far": scale.far}


def _to_scale(scale: Scale, kept: Any) -> Scale:
    """Return a scale with what is kept of it; a fixed one stays as it is."""
    if scale.fixed is not None:
        return scale
    number, mean, sd, lone, far = (kept[name] for name in ("number", "mean", "sd", "lone", "far"))
    _checks.whole("number of a scale", number, high=LARGEST_COUNT)
    _checks.number("mean of a scale", mean)
    _checks.number("sd of a scale", sd, low=0)
    _checks.whole("far of a scale", far, high=LARGEST_COUNT)
    if lone is not None:
        _checks.number("lone number of a scale", lone)
    return Scale(Moments(number, float(mean), float(sd)), None if lone is None else float(lone), far)


def _of_stream(stream: RewardStream) -> dict[str, Any]:
    kept = stream.state()
    arrays = {name: {"shape": x.shape, "data": x.ravel().tolist()} for name, x in kept.arrays.items()}
    return {"plain": kept.plain, "arrays": arrays}


def _to_stream(stream: RewardStream, kept: Any) -> RewardStream:
    stream = copy.deepcopy(stream)
    arrays = {name: np.array(x["data"]).reshape(x["shape"]) for name, x in kept["arrays"].items()}
    stream.restore(State(kept["plain"], arrays))
    return stream
