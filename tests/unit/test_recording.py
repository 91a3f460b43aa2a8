"""Clips: sprite sheets, pieces of episodes, and environments that cannot be recorded."""

import importlib.util
import subprocess
import sys
import time

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import uard.envs
from uard import InvalidValueError
from uard.collect import Project, drawing, sheets
from uard.collect.record import record

Spaces = gymnasium.spaces


class Counter(gymnasium.Env):
    """Counts its steps, and ends after some; what it draws and pays can be wrong."""

    def __init__(self, mode="rgb_array", lasts=20, draw=None, pay=None, observe=None, space=None):
        self.metadata = {"render_modes": ["rgb_array", "ansi"], "render_fps": 100}
        self.render_mode, self.lasts = mode, lasts
        self.observation_space = Spaces.Box(0, 1e9, (1,)) if space is None else space
        self.action_space = Spaces.Discrete(2)
        self.draw = draw or (lambda n: np.full((200, 180, 3), n % 256, np.uint8))
        self.pay = pay or (lambda n: float(n))
        self.observe = observe or (lambda n: np.array([n], np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n = 0
        return self.observe(0), {}

    def step(self, action):
        self.n += 1
        return self.observe(self.n), self.pay(self.n), self.n >= self.lasts, False, {"true_reward": -7.0}

    def render(self):
        return self.draw(self.n)


def go(action):
    return lambda observation: action


@pytest.fixture
def project(tmp_path):
    return Project.create(tmp_path / "project")


def arrays_of(item, project):
    with np.load(project.media(item.content["data"]), allow_pickle=False) as found:
        return {name: found[name] for name in found.files}


def frames_of(item, project):
    c = item.content
    return sheets.frames_of(
        project.media(c["sheet"]).read_bytes(), c["frames"], c["columns"], (c["width"], c["height"])
    )


# sheets


@settings(max_examples=25)
@given(
    st.tuples(st.integers(1, 7), st.integers(1, 30), st.integers(1, 30)).flatmap(
        lambda s: arrays(np.uint8, (*s, 3), elements=st.sampled_from([0, 1, 127, 255]), fill=st.just(9))
    )
)
def test_frames_of_few_colours_come_back_as_they_were(frames):
    sheet = sheets.sheet_of(frames)
    scale = 256 // max(frames.shape[1:3])
    back = sheets.frames_of(*sheet)
    np.testing.assert_array_equal(back, frames.repeat(scale, 1).repeat(scale, 2))
    assert (sheet.columns - 1) ** 2 < len(frames) <= sheet.columns**2


def test_large_frames_become_smaller_and_photographs_lossy():
    random = np.random.default_rng(0)
    smooth = np.linspace(0, 255, 300 * 600 * 3).reshape(300, 600, 3)
    frames = np.clip(smooth + random.normal(0, 3, (2, 300, 600, 3)), 0, 255).astype(np.uint8)
    sheet = sheets.sheet_of(frames)
    assert sheet.size == (256, 128)
    exact = np.stack([sheets.fitted(frame) for frame in frames]).astype(float)
    assert 0 < np.abs(sheets.frames_of(*sheet) - exact).mean() < 4
    assert len(sheet.data) < exact.size / 8


def test_the_largest_sheet_can_be_shown():
    sheet = sheets.sheet_of(np.zeros((sheets.MOST_FRAMES, 256, 256, 3), np.uint8))
    assert sheet.columns * sheet.size[0] == sheets.LARGEST_SIDE


@pytest.mark.parametrize(
    "frames",
    [
        np.zeros((2, 3, 4)),
        np.zeros((2, 3, 4, 3)),
        np.zeros((0, 3, 4, 3), np.uint8),
        [[1]],
        np.zeros((1025, 1, 1, 3), np.uint8),
    ],
)
def test_what_is_no_film_is_refused(frames):
    with pytest.raises(InvalidValueError, match=r"frames = .*must be an array"):
        sheets.sheet_of(frames)


def test_a_sheet_that_is_none_is_refused():
    with pytest.raises(InvalidValueError, match="the bytes of a picture"):
        sheets.frames_of(b"no picture", 1, 1, (2, 2))
    sheet = sheets.sheet_of(np.zeros((4, 160, 160, 3), np.uint8))
    with pytest.raises(InvalidValueError, match="sheet = '320 x 320': must be 480 x 320, for 5 frames"):
        sheets.frames_of(sheet.data, 5, 3, sheet.size)


def test_without_pillow_it_is_said_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'uard\[collect\]'"):
        sheets.sheet_of(np.zeros((1, 200, 200, 3), np.uint8))


# clips


def test_a_clip_has_a_frame_before_and_after_each_step_and_no_truth(project):
    clips = record(Counter(lasts=1000), go(1), project, segments=6, length=5, stratum="one")
    assert len(clips) == 6
    starts = []
    for clip in clips:
        found, frames = arrays_of(clip, project), frames_of(clip, project)
        assert sorted(found) == ["actions", "observations", "rewards"]
        assert all(array.dtype != object for array in found.values())
        start = int(found["observations"][0, 0])
        starts.append(start)
        assert found["observations"][:, 0].tolist() == list(range(start, start + 6))
        assert found["rewards"].tolist() == list(range(start + 1, start + 6))
        assert found["actions"].tolist() == [1] * 5
        assert frames[:, 0, 0, 0].tolist() == list(range(start, start + 6))
        assert clip.reward == start + 3
        assert clip.content["fps"] == 30.0
    gaps = np.diff(starts) - 5
    assert len(set(gaps)) > 1
    assert (gaps >= 0).all()
    with project.store() as store:
        assert set(store.items()[0]) == set(clips)


@pytest.mark.parametrize(("lasts", "length"), [(1, 5), (3, 5), (7, 50), (20, 8), (20, 1)])
def test_no_clip_crosses_the_end_of_an_episode(project, lasts, length):
    for clip in record(Counter(lasts=lasts), go(0), project, segments=8, length=length):
        seen = arrays_of(clip, project)["observations"][:, 0]
        assert (np.diff(seen) == 1).all()
        assert 2 <= len(seen) <= length + 1
        assert len(seen) == length + 1 or seen[-1] == lasts


def test_the_same_content_is_the_same_item(project, tmp_path, monkeypatch):
    env = gymnasium.make("uard/TrapGrid6-v0", render_mode="rgb_array")
    first = record(env, "random", project, segments=4, length=3, seed=1)
    monkeypatch.setattr(time, "time", lambda: 2e9)  # nothing of a file says when it was made
    other = Project.create(tmp_path / "other")
    assert record(env, "random", other, segments=4, length=3, seed=1) == first
    with project.store() as store:
        record(env, "random", project, segments=4, length=3, seed=1)
        assert len(store.items()[0]) == 4
    assert record(env, "random", other, segments=4, length=3, seed=2) != first


def test_where_there_is_nothing_new_it_ends(project):
    assert len(record(Counter(lasts=2), go(0), project, segments=50, length=1)) == 2


def test_single_steps_of_numbered_worlds_are_keyed(project):
    env = gymnasium.make("uard/TrapGrid6-v0", render_mode="rgb_array")
    for clip in record(env, "random", project, segments=5, length=1):
        found = arrays_of(clip, project)
        assert clip.content["key"] == [found["observations"][0], found["actions"][0]]
        assert clip.content["frames"] == 2
    assert all(c.content["key"] is None for c in record(env, "random", project, segments=2, length=2))
    assert all(c.content["key"] is None for c in record(Counter(), go(0), project, segments=2, length=1))


def test_dictionaries_are_made_flat(project):
    space = Spaces.Dict({"place": Spaces.Box(0, 100, (2,)), "door": Spaces.Discrete(2)})
    env = Counter(space=space, observe=lambda n: {"place": np.array([n, 1], np.float32), "door": n % 2})
    (clip,) = record(env, go(0), project, segments=1, length=2)
    assert arrays_of(clip, project)["observations"].shape == (3, 4)


def test_progress_is_told(project):
    told = []
    record(Counter(), go(0), project, segments=3, length=2, progress=lambda *x: told.append(x))
    assert told == [(1, 3), (2, 3), (3, 3)]


def fails(n):
    raise RuntimeError("no screen")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mode": "ansi"}, "render_mode = 'ansi': must be 'rgb_array', as in gymnasium.make"),
        ({"mode": None}, "render_mode = None: must be 'rgb_array'"),
        ({"draw": lambda n: "a text"}, r"render\(\) = 'a text': must be a picture"),
        ({"draw": lambda n: None}, r"render\(\) = None: must be a picture"),
        ({"draw": lambda n: [np.zeros((9, 9, 3), np.uint8)]}, r"render\(\) = 'a list': must be a picture"),
        ({"draw": lambda n: np.zeros((9, 9), np.uint8)}, r"render\(\) = 'uint8 \(9, 9\)': must be a picture"),
        ({"draw": lambda n: np.zeros((9, 9, 3))}, r"render\(\) = 'float64 .*must be a picture"),
        ({"draw": lambda n: np.zeros((9 + n // 3, 9, 3), np.uint8)}, r"render\(\).shape = .*as in the pictures before"),
        ({"draw": fails}, r"render\(\) = 'RuntimeError: no screen': must be a picture, and the environment failed"),
        ({"pay": lambda n: np.nan}, "reward of step 1 = nan: must be a finite number"),
        ({"pay": lambda n: None}, "reward of step 1 = None: must be a finite number"),
        ({"pay": lambda n: 1e200}, "reward of step 1 = 1e"),
        (
            {"space": Spaces.Sequence(Spaces.Discrete(2)), "observe": lambda n: (0,) * n},
            "observation_space = .*flattened",
        ),
        ({"observe": lambda n: np.zeros(1 + n)}, r"observation.shape = .*must be the same in all steps"),
        ({"observe": lambda n: np.array([None])}, "observation_space = .*of numbers"),
    ],
)
def test_what_cannot_be_recorded_is_refused_and_adds_nothing(project, arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        record(Counter(**arguments), go(0), project, segments=3, length=9)
    with project.store() as store:
        assert store.items()[0] == ()


def test_an_environment_without_pictures_is_named(project):
    with pytest.raises(InvalidValueError, match=r"uard/BoatRace-v0 draws no pictures \(it has ansi"):
        record(gymnasium.make("uard/BoatRace-v0", render_mode="ansi"), "random", project)
    assert uard.envs


@pytest.mark.parametrize(
    ("name", "value"),
    [("segments", 0), ("length", 0), ("length", 1024), ("seed", -1), ("fps", 0), ("fps", np.nan), ("stratum", 3)],
)
def test_arguments_are_checked(project, name, value):
    with pytest.raises(InvalidValueError, match=f"{name} = "):
        record(Counter(), "random", project, **{name: value})


def test_an_unknown_policy_is_named(project):
    with pytest.raises(InvalidValueError, match="policy = 'randon': must be one of random"):
        record(Counter(), "randon", project)


# MuJoCo


def test_the_graphics_library_is_chosen_by_trying(monkeypatch):
    pytest.importorskip("mujoco")
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    tried = []

    def fake(command, env, **_):
        tried.append(env["MUJOCO_GL"])
        return subprocess.CompletedProcess(command, int(env["MUJOCO_GL"] != "osmesa"))

    monkeypatch.setattr(drawing.subprocess, "run", fake)
    monkeypatch.setattr(drawing.sys, "platform", "linux")
    monkeypatch.setattr(drawing.importlib, "reload", lambda module: None)
    env = Counter()
    env._simulator = None
    drawing.find_library(env)
    assert tried == ["egl", "osmesa"]
    assert drawing.os.environ["MUJOCO_GL"] == "osmesa"
    drawing.find_library(env)
    assert len(tried) == 2


def test_the_core_imports_neither_pillow_nor_a_server():
    code = (
        "import sys, uard.collect, uard.collect.record, uard.collect.texts;"
        "print([m for m in ('PIL', 'starlette', 'uvicorn', 'jinja2', 'jax', 'mujoco') if m in sys.modules])"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"
    assert importlib.util.find_spec("PIL")
