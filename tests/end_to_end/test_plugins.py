import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from markupsafe import Markup

from uard import InvalidValueError, plugins
from uard._checks import UnknownNameError
from uard.agents.tabular import QLearning
from uard.cli import app as cli
from uard.cli import settings
from uard.lab import registry as names
from uard.lab import studies
from uard.lab.cell import Cell
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from uard.lab.studies import plugins as own
from uard.lab.views import leaderboard, sections
from uard.lab.views.study_results import StudyResults
from uard.method import mitigations as mitigation
from uard.method.mitigations import Raw, named
from uard.plugins import PluginError

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).parents[2] / "examples" / "uard-plugin-example"
BROKEN = """
from dataclasses import dataclass
from uard.agents.base import Agent
from uard.envs.base import Environment
from uard.envs.grids.trapgrid import TrapGrid
from uard.method.mitigations import Mitigation, Raw

@dataclass(frozen=True)
class Mine(Raw):
    pass

@dataclass
class Thawed(Mitigation):
    def signal(self, results, usual):
        return evidence.reward

def three():
    return 3

def raises():
    raise RuntimeError("not today")

@dataclass(frozen=True)
class Command:
    def run(self, console):
        print("mine ran")

def quits():
    raise SystemExit(0)

@dataclass(frozen=True)
class Quits(Raw):
    now: bool = False

    def __post_init__(self):
        if self.now:
            raise SystemExit(0)

@dataclass(frozen=True)
class Kindless(Environment):
    horizon: int = 5

@dataclass(frozen=True)
class Unfamiliar(Agent):
    pass

@dataclass(frozen=True)
class Trapdoor(TrapGrid):
    def task(self, *_):
        raise SystemExit(0)

def trapdoor():
    from uard.lab.cell import Cell
    from uard.lab.study import Study, row
    return {"doors": (Study("trapdoor", "t", "a", (row(Cell(Trapdoor(3), episodes=5), a=1),)),)}

def taken():
    return {"mine": (study("control"),)}

def named_like_a_study():
    return {"matrix": (study("other"),)}

def twice():
    return {"mine": (study("new"), study("new"))}

def study(name):
    from uard.lab.cell import Cell
    from uard.lab.study import Study, row
    return Study(name, "t", "a", (row(Cell(), a=1),))

def sections(results):
    return [results.get("no such study", "hacks")]

def made_already(results):
    from uard.lab.views.sections import Section
    return [Section("made", "Made", 1, "<p>twice</p>")]

def several(results):
    from uard.lab.views.sections import Section
    inside = Section("inside", "Inside", 4, '<p id="losses-table">x</p>')
    capital = Section("capital", "Capital", 5, "", files={"Shared.json": ""})
    open_ = Section("open", "Open", 6, "<p>x<!-- y")
    away = Section("away", "Away", 7, "<meta http-equiv=refresh content=0>")
    table = Section("table", "Table", 7.5, "<svg><desc><table/></desc></svg>")
    store = Section("store", "Store", 7.6, "", files={"kept.sqlite": "gone"})
    drawing = "<svg><title>t</title><path d='M0'/></svg>"
    good = Section("good", "Good", 8, f"<p title='a > b' id=good-part>{drawing}</p>", files={"shared.json": ""})
    return [inside, open_, away, table, store, good, capital]
"""
OLD = """
from uard.method.mitigations import Mitigation

class Old(Mitigation):
    def signal(self, reward, sigma_m, feedback):
        return reward
"""
ENTRIES = """
[uard.mitigations]
gone = no_such_module:Thing
missing = uard_broken:Nothing
three = uard_broken:three
raises = uard_broken:raises
thawed = uard_broken:Thawed
old = uard_old:Old
exits = uard_broken:quits
raw = uard_broken:Mine
twice = uard_broken:Mine
[uard.environments]
nowhere = uard_broken:Mine
kindless = uard_broken:Kindless
[uard.agents]
unfamiliar = uard_broken:Unfamiliar
sac = uard_broken:Mine
[uard.commands]
run = uard_broken:Command
thaw = uard_broken:Thawed
lost = uard_broken:Nothing
[uard.studies]
absent = no_such_module:studies
quits = uard_broken:quits
mine = uard_broken:three
control = uard_broken:taken
group = uard_broken:named_like_a_study
twice = uard_broken:twice
[uard.results]
odd = uard_broken:three
[uard.reports]
gone = uard_broken:Nothing
late = uard_broken:sections
made = uard_broken:made_already
several = uard_broken:several
"""


def distribution(folder, name, entries):
    place = folder / f"{name}-1.0.dist-info"
    place.mkdir()
    (place / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (place / "entry_points.txt").write_text(entries)


@pytest.fixture(scope="session")
def installed(shared):
    """The example as pip installs it, offline."""
    with shared("plugins") as folder:
        if not (target := folder / "target").exists():
            shutil.copytree(EXAMPLE, folder / "source")
            pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
            subprocess.run([*pip, "--target", target, folder / "source"], check=True)
        return target


@pytest.fixture
def example(installed, monkeypatch):
    monkeypatch.syspath_prepend(installed)
    plugins.found.cache_clear()
    yield importlib.import_module("uard_plugin_example")
    plugins.found.cache_clear()


@pytest.fixture
def broken(example, tmp_path, monkeypatch):
    """Beside the example, two packages of which nothing works."""
    (tmp_path / "uard_broken.py").write_text(BROKEN)
    (tmp_path / "uard_old.py").write_text(OLD)
    distribution(tmp_path, "broken", ENTRIES)
    distribution(tmp_path, "other", "[uard.mitigations]\ntwice = uard_broken:Mine\n")
    monkeypatch.syspath_prepend(tmp_path)
    plugins.found.cache_clear()


def listed(capsys):
    cli.main(["list"])
    out, err = capsys.readouterr()
    return {line.split()[0] for line in out.splitlines() if line.strip()}, out, err


def test_they_are_listed_with_their_package(example, capsys):
    names_, text, err = listed(capsys)
    assert names_ >= {"ceiling", "BellCorridor", "softmax-dqn", "own", *mitigation.NAMED, *names.ENVIRONMENTS}
    assert re.search(r"\n  ceiling +\S.* \(of uard-plugin-example 0\.1\)\n", text)
    assert err == ""


def test_broken_ones_are_told_and_disturb_nobody(broken, capsys):
    names_, _, err = listed(capsys)
    assert names_ >= {"ceiling", "BellCorridor", "softmax-dqn", *mitigation.NAMED}
    warnings = [line.removeprefix("warning: ") for line in err.splitlines()]
    assert sorted(w.split(": must be usable")[0] for w in warnings) == [
        *(f"agent = {name!r}" for name in ("sac", "unfamiliar")),
        *(f"command = {name!r}" for name in ("lost", "run", "thaw")),
        *(f"environment = {name!r}" for name in ("kindless", "nowhere")),
        *(f"mitigation = {name!r}" for name in ("exits", "gone", "missing", "old", "raises", "raw")),
        *(f"mitigation = {name!r}" for name in ("thawed", "three", "twice", "twice")),
        "report = 'gone'",
        "results = 'odd'",
        *(f"studies = {name!r}" for name in ("absent", "control", "group", "mine", "quits", "twice")),
    ]
    assert all("of package broken 1.0: " in w or "of package other 1.0: " in w for w in warnings)
    for says in (
        "package broken 1.0: the name is uard's own command",
        "Thawed'> is no frozen dataclass with a method run",
        "AttributeError: module 'uard_broken' has no attribute 'Nothing'",
        "ModuleNotFoundError: No module named 'no_such_module'",
        "SystemExit: 0",
        "what it gives, Kindless(horizon=5), must be an Environment that declares its kind: tables, world, simulator",
        "what it gives, Unfamiliar(), must be an Agent that declares its family: tabular, replay, rollout",
        "Old.signal = '(self, reward, sigma_m, feedback)': must be (self, evidence, statistics)",
        "3 is no dictionary of groups, (Study, ...) by name",
        "the name of its study 'control' is taken",
        "the name of its group 'matrix' is that of a study",
        "the name of its study 'new' is taken",
        "3 is no ResultFiles",
    ):
        assert any(says in w for w in warnings), says


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("gone", "entry point gone = no_such_module:Thing of package broken 1.0: ModuleNotFoundError: No module named"),
        ("missing", "entry point missing = .* of package broken 1.0: AttributeError: .*Nothing"),
        ("three", "what it gives, 3, must be a frozen dataclass that is a Mitigation"),
        ("raises", "RuntimeError: not today"),
        ("exits", "SystemExit: 0"),
        ("old", r"Old\.signal = .*must be \(self, evidence, statistics\)"),
        ("thawed", "what it gives, .*Thawed.*, must be a frozen dataclass that is a Mitigation"),
        ("twice", "the name is also brought by other 1.0"),
    ],
)
def test_a_broken_one_says_why_when_it_is_asked_for(broken, name, why):
    with pytest.raises(PluginError, match=why):
        named(name)


def test_a_package_that_calls_sys_exit_never_ends_a_command_as_if_all_were_done(installed, tmp_path):
    """Wherever it does so; in the real program, whose exit code counts."""
    (tmp_path / "uard_broken.py").write_text(BROKEN)
    entries = """
[uard.mitigations]
quits = uard_broken:Quits
[uard.studies]
trapdoor = uard_broken:trapdoor
"""
    distribution(tmp_path, "broken", entries)
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    uard = Path(sys.executable).parent / "uard"
    for command, says in (
        ("run --mitigation quits --set-mitigation now=true --seeds 1", "uard_broken.py, line"),
        ("reproduce trapdoor --seeds 2 --workers 1", ""),
        ("reproduce trapdoor --seeds 2 --workers 2", ""),
    ):
        done = subprocess.run(
            [uard, *command.split()],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": path},
        )
        assert (done.returncode, done.stdout) == (1, ""), done.stderr
        assert "error: " in done.stderr
        assert says in done.stderr
        assert "Traceback" not in done.stderr.partition("failed: ")[2]


def test_our_own_names_are_no_plugins(example):
    with pytest.raises(UnknownNameError, match="mitigation = 'raw'"):
        plugins.pick("mitigation", "raw", mitigation.NAMED, [*mitigation.NAMED])


def test_what_is_of_another_kind_or_has_our_name_is_not_taken(broken):
    with pytest.raises(PluginError, match=r"Mine\(\), must be a frozen dataclass that is an Environment"):
        names.environment("nowhere", {})
    assert type(named("raw")) is Raw
    assert names.agent("sac", {}) == names.AGENTS["sac"]
    with pytest.raises(UnknownNameError, match="did you mean 'ceiling'"):
        named("cieling")


def test_fields_are_set_like_those_of_ours(example):
    assert settings.mitigation("ceiling", {"slack": 1}) == named("ceiling", slack=1.0) == example.Ceiling(1.0)
    assert names.environment("BellCorridor", {"length": 11}) == example.BellCorridor(11)
    assert names.agent("softmax-dqn", {"heat": 1, "network.hidden": 16}).network.hidden == 16
    with pytest.raises(InvalidValueError, match="slack = -1"):
        named("ceiling", slack=-1)
    hopper = names.ENVIRONMENTS["Hopper"]
    with pytest.raises(InvalidValueError, match="one that can work in Hopper"):
        Cell(hopper, agent=names.agent("softmax-dqn", {}, hopper))


def test_a_cell_is_keyed_by_class_and_fields(example):
    cell = Cell(example.BellCorridor(), example.Ceiling())
    config = cell.config()
    assert config["mitigation"] == {"type": "uard_plugin_example/Ceiling", "slack": 0.5}
    assert config["environment"]["type"] == "uard_plugin_example/BellCorridor"
    others = [
        cell.with_(mitigation=example.Ceiling(0.4)),
        cell.with_(environment=example.BellCorridor(legitimate=True)),
    ]
    assert len({c.key for c in (cell, *others)}) == 3
    assert cell.with_(mitigation=example.Ceiling(0.5)).key == cell.key


def test_workers_train_them_as_this_process_does_and_the_leaderboard_has_their_row(example):
    here, there = Store(":memory:"), Store(":memory:")
    cells = [Cell(example.BellCorridor(), m) for m in (Raw(), named("uard"), example.Ceiling(0.1))]
    jobs = [(c, seed) for c in cells for seed in (0, 1, 2)]
    runner.run(jobs, here, workers=0)
    runner.run(jobs, there, workers=2)
    for c, seed in jobs:
        assert here.get(c, [seed])[seed].pack() == there.get(c, [seed])[seed].pack()
    board = {x.mitigation: x for x in leaderboard.lines(there)}
    assert board.keys() == {"raw", "uard", "ceiling, slack 0.1"}
    assert {x.environment for x in board.values()} == {"BellCorridor"}
    assert board["raw"].hacks.ci95[0] > 0.5, "the bell is worth hacking"
    assert board["raw"].hacks.ci95[0] > board["ceiling, slack 0.1"].hacks.ci95[1]
    here.close()
    there.close()


def test_a_deep_agent_of_a_package_learns_from_the_command_line(installed):
    """In a process of its own, as a user has it."""
    path = os.pathsep.join([str(installed), os.environ.get("PYTHONPATH", "")])
    options = [
        "--set",
        "length=3",
        "--agent",
        "softmax-dqn",
        "--set-agent",
        "network.hidden=8",
        "--mitigation",
        "ceiling",
    ]
    done = subprocess.run(
        [Path(sys.executable).parent / "uard", "run", "BellCorridor", *options, "--seeds", "1", "--episodes", "20"],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": path},
    )
    assert done.returncode == 0, done.stderr
    assert "BellCorridor / softmax-dqn / ceiling" in done.stdout


def test_a_mitigation_joins_every_study_that_compares_some(example):
    plain, joined = studies.every(), studies.find(tuple(studies.groups()), ("ceiling",))
    grown = {b.name: len(b.rows) - len(a.rows) for a, b in zip(plain, joined, strict=True) if len(b.rows) > len(a.rows)}
    assert grown.keys() >= {"matrix", "legitimate", "budgets", "unseen", "sources", "deep-rivals", "gaming"}
    assert grown["matrix"] == 126
    for study in joined:
        for row in study.where(mitigation="ceiling"):
            assert row.cell.mitigation == example.Ceiling()
            if study.name != "own":
                beside = next(name for name in ("uard", "uard-0.1") if any(study.where(mitigation=name)))
                twin = study.one(**dict(row.labels) | {"mitigation": beside} | _sources(row))
                model = row.cell.rating_model  # in games every rule has the one it was published with
                assert row.cell == twin.cell.with_(mitigation=example.Ceiling(), rating_model=model)


def _sources(row):
    return {"sources": "-"} if "sources" in dict(row.labels) else {}


def test_one_that_is_there_already_joins_nothing():
    assert studies.find(("matrix",), ("lcb", "lcb")) == studies.find(("matrix",))
    with pytest.raises(InvalidValueError, match="none of scale, control compares mitigations"):
        studies.find(("scale", "control"), ("lcb",))
    with pytest.raises(UnknownNameError):
        studies.find(("matrix",), ("nonsense",))


def test_what_packages_bring_has_a_study(example):
    (study,) = own.brought()
    assert study.name == "own"
    everywhere = {(r["environment"], r["agent"], r["panel"]) for r in study.rows}
    assert everywhere == {
        *(("BellCorridor", "q-learning", p) for p in ("main", "appendix", "colluding")),
        *(("BellCorridor, legitimate", "q-learning", p) for p in ("main", "appendix")),
        *(("TrapGrid6", "softmax-dqn", p) for p in ("main", "appendix", "colluding")),
        *(("TrapGrid6, legitimate", "softmax-dqn", p) for p in ("main", "appendix")),
    }
    assert {r["mitigation"] for r in study.rows} == {*own.mitigations()} >= {"raw", "uard", "ceiling"}
    oracles = sum(agent == "softmax-dqn" for _, agent, _ in everywhere)  # only tables are trained on the truth
    assert len(study.rows) == len(everywhere) * len(own.mitigations()) - oracles
    assert all(r.cell.environment.legitimate == r["environment"].endswith("legitimate") for r in study.rows)
    assert isinstance(study.rows[0].cell.agent, QLearning)


def test_studies_of_packages_stand_beside_ours(example, broken, capsys):
    groups = studies.groups()
    assert [s.name for s in groups["bells"]] == ["loudness"]
    assert groups.keys() >= {"grid", "games", "plugins", "grid-deep", "mujoco-standard"}
    assert {s.name for s in groups["grid"]} > {"matrix", "control", "scale", "table5"}, "groups of one name are joined"
    assert [s.name for s in studies.find(("loudness",))] == [s.name for s in studies.find(("bells",))] == ["loudness"]
    assert {"loudness"} <= listed(capsys)[0]


def test_a_command_of_a_package_runs_and_none_takes_the_name_of_ours(installed, broken, capsys):
    cli.main(["bells", "--bell", "4"])
    out, err = capsys.readouterr()
    assert out == "2.5 rings pay as much as the goal\n"
    assert sum("warning: command = " in line for line in err.splitlines()) == 3
    with pytest.raises(SystemExit) as stopped:
        cli.main(["bells", "--bell", "-1"])
    assert stopped.value.code == 2
    assert "error: bell = -1.0: must be a number > 0" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stopped:
        cli.main(["run", "--help"])
    assert stopped.value.code == 0
    assert "Train one agent" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stopped:
        cli.main(["nonsense"])
    assert stopped.value.code == 2
    assert "bells" in capsys.readouterr().err, "the error says what exists"


def test_sections_of_packages_join_the_report(broken, tmp_path):
    """Made from evidence without numbers where none is needed: what is tested is who gets onto the page."""
    store = Store(":memory:")
    (control,) = studies.find(("control",))
    runner.run(control.jobs(range(2)), store, workers=1)
    results = StudyResults(store, range(2), studies.grid())
    good, bad = sections.of_packages(
        results, [sections.Section("made", "How this was made", 1000, "")], ["kept.sqlite"]
    )
    (section,) = (s for s in good if s.id == "example")
    assert "a random walker, 6x6" in section.html
    assert [loss.sentence() for loss in section.losses] == ["bells: nobody has tried uard on bells of 1000."]
    why = {error.plugin.name: str(error) for error in bad}
    assert "AttributeError" in why["gone"]
    assert "study = 'no such study': must be one of" in why["late"]
    assert "its section 'made' is left out, for the name 'made' in it is taken" in why["made"]
    assert [s.id for s in good if s.id not in ("example",)] == ["good"], "one fault costs one section"
    several = [str(error).partition("its section ")[2] for error in bad if error.plugin.name == "several"]
    assert several == [
        "'inside' is left out, for the name 'losses-table' in it is taken",
        "'open' is left out, for <!-- begins what no part of a page needs: comments, declarations",
        "'away' is left out, for <meta> in line 1 is not for a part of a page",
        "'table' is left out, for </desc> in line 1 ends what is not open, or is not the innermost",
        "'store' is left out, for the name 'kept.sqlite' in it is taken",
        "'capital' is left out, for the name 'shared.json' in it is taken",
    ]


def test_names_are_first_of_all_uards_own(broken):
    assert plugins.found("report")[0].name == "replication"


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"id": "Two words"}, "id = 'Two words': must be small letters"),
        ({"order": float("nan")}, "order = nan: must be a finite number"),
        ({"js": "'</SCRIPT>'"}, "js = \"'</SCRIPT>'\": must be without </script"),
        ({"js": "'<!--<script>'"}, "must be without <!--"),
        ({"css": "</style>"}, "css = '</style>': must be without </style"),
        ({"css": "a\0"}, "css = 'a\\x00': must be text without NUL"),
        ({"html": None}, "html = None: must be text"),
        ({"title": "x" * 500}, "must be at most 120 characters"),
        ({"files": None}, "files = None: must be a mapping of names to texts"),
        ({"files": {"x.txt": b"x"}}, "files['x.txt'] = b'x': must be text"),
        ({"files": {"x" * 300: ""}}, "must be a plain name"),
        ({"losses": iter(())}, "must be a tuple of uard.lab.views.losses.Loss"),
        ({"files": {"../up": ""}}, "files = '../up': must be a plain name"),
        ({"files": {"index.html": ""}}, "files = 'index.html': must be a plain name, none of index.html"),
        ({"page": "other.html"}, "page = 'other.html': must be one of index.html, numbers.html, paper.html"),
        ({"losses": ("It hacks.",)}, "losses = 'It hacks.': must be of uard.lab.views.losses.Loss"),
    ],
)
def test_silly_sections_are_refused(fields, says):
    with pytest.raises(InvalidValueError, match=re.escape(says)):
        sections.Section(**({"id": "x", "title": "t", "order": 1, "html": ""} | fields))


def test_what_was_checked_is_not_changed_afterwards():
    given = {"a.csv": ""}
    section = sections.Section("x", Markup("<b>"), 1, "", files=given)
    given["../up.csv"] = ""
    assert (dict(section.files), type(section.title)) == ({"a.csv": ""}, str)


def test_nothing_is_imported_before_it_is_asked_for(installed):
    code = "import sys, uard.method.mitigations as m; m.named('uard'); print('uard_plugin_example' in sys.modules)"
    path = os.pathsep.join([str(installed), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=os.environ | {"PYTHONPATH": path})
    assert done.stdout.strip() == b"False"
