"""A run of GRPO on the language: what it starts from, what it writes down, and that seeds decide."""

import numpy as np
import pytest
import torch

from uard import InvalidValueError
from uard.lab.cell import Cell
from uard.lab.execution.store import Store
from uard.lab.execution.training import train_batch
from uard.lab.language import training
from uard.lab.language.setting import Grpo, Language
from uard.lab.result import Result
from uard.lab.studies import grpo
from uard.lab.study import Study, row
from uard.lab.views import grpo as shown
from uard.lab.views.published import Published, extract
from uard.method.mitigations import named
from uard.ratings.panels import PANELS

SMALL = Language("shared bias", taught=3, pairs=20, compared=2)
AGENT = Grpo(prompts=2, completions=3)
STEPS = 4


def cell(mitigation):
    return Cell(SMALL, named(mitigation), AGENT, steps=STEPS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("models")


@pytest.fixture(scope="module")
def run(folder):
    torch.set_num_threads(1)
    return lambda mitigation, seed=0: cell(mitigation).trainer.train([(cell(mitigation), seed)], folder)[0]()


@pytest.fixture(scope="module")
def discounted(run):
    return run("uard")


def test_an_episode_is_an_answer(discounted):
    assert discounted.log.shape == (STEPS * AGENT.batch, 6)
    assert discounted.extra["judges"].shape == (STEPS * AGENT.batch, 5)
    assert discounted.steps == discounted.log[:, 4].sum()
    assert np.isfinite(discounted.extra["divergence"]).all()
    # Before anything is learned, nothing is more probable than it was.
    assert discounted.extra["divergence"][: AGENT.batch] == pytest.approx(0.0, abs=1e-5)
    assert Result.unpack(*discounted.pack()).metrics() == discounted.metrics()


def test_models_from_files_are_those_that_were_trained(discounted, folder):
    assert list(folder.glob("language-*.pt"))
    training.prepared.cache_clear()
    (again,) = train_batch([(cell("uard"), 0)])  # which keeps no files
    assert again.pack() == discounted.pack()


class Trap:
    def __reduce__(self):
        return exec, ("raise SystemExit('executed')",)


@pytest.mark.parametrize("content", ["", "text", [1, 2], {"weight": torch.zeros(2)}, Trap()])
def test_a_file_that_is_no_kept_model_is_named_and_never_executed(content, tmp_path):
    small = Language(taught=1, pairs=2, compared=1)
    training._taught(0, small.taught, tmp_path)
    (file,) = tmp_path.glob("language-*.pt")
    if isinstance(content, str):
        file.write_text(content)
    else:
        torch.save(content, file)
    with pytest.raises(InvalidValueError, match=f"{file.name}.*delete it, and it is made again"):
        training._taught(0, small.taught, tmp_path)
    file.unlink()
    assert training._taught(0, small.taught, tmp_path) is not None


def test_rules_and_seeds_differ(run, discounted):
    logs = [discounted.log, run("median").log, run("true-reward").log, run("raw").log, run("uard", seed=1).log]
    assert len({log.tobytes() for log in logs}) == len(logs)


def test_gold_is_learned_by_who_is_told_it(folder):
    told = Cell(SMALL, named("true-reward"), Grpo(1e-3, prompts=2, completions=8), steps=25)
    (finish,) = told.trainer.train([(told, 0)], folder)
    gold = finish().log[:, 1].reshape(25, -1).mean(1)
    assert gold[-5:].mean() > gold[:5].mean() + 1.0  # loose words cost a quarter each, and hardly taught it says many


def test_nonsense_is_named():
    for field, value in (("condition", "none"), ("taught", 0), ("pairs", 1), ("compared", 0)):
        with pytest.raises(InvalidValueError, match=field):
            Language(**{field: value})
    for field, value in (("learning_rate", 0), ("prompts", 0), ("completions", 1)):
        with pytest.raises(InvalidValueError, match=field):
            Grpo(**{field: value})
    with pytest.raises(InvalidValueError, match="agent"):
        Cell(SMALL)  # tables cannot hold answers


def test_the_judges_are_those_of_the_language():
    assert Cell(SMALL, named("uard"), AGENT, steps=STEPS, panel=PANELS["colluding"], noise=1.0, rated=0.1) == cell(
        "uard"
    )


def test_gold_at_equal_distance_by_hand():
    divergence, gold = np.array([0.0, 1.0, 0.5, 3.0, 4.0]), np.array([1.0, 2.0, 9.0, 0.0, -2.0])
    at = [shown.at_distance(divergence, gold, x) for x in (0.5, 1.0, 2.0, 3.5)]
    assert at == pytest.approx([1.5, 2.0, 1.0, -1.0])
    assert np.isnan(shown.at_distance(divergence, gold, 4.5))


def test_what_is_published_is_what_is_shown(run, discounted):
    names = {"uard": "uard", "mean": "mean-of-annotations", "true reward": "true-reward"}
    rows = tuple(row(cell(m), condition="shared bias", rule=rule) for rule, m in names.items())
    study = Study("grpo", "GRPO", "", rows, derive=grpo.curves)
    store = Store(":memory:")
    store.put([(r.cell, seed, run(names[r["rule"]], seed)) for r in rows for seed in (0, 1)])
    found = Published([study], [extract([study], store, [0, 1], "by hand")])
    gold = found.derived(rows[0], "gold")
    assert gold.shape == (2, STEPS // grpo.BIN)
    assert gold[0, 0] == pytest.approx(discounted.log[: grpo.BIN * AGENT.batch, 1].mean(), rel=1e-4)
    assert "trl" in found.sources[0]["packages"]
    (table,) = shown.tables(found)
    assert [line[0] for line in table.rows] == [*names]
    assert "Rivals against uard" in table.note
    (section,) = shown.section(found)
    assert {loss.where for loss in section.losses} <= {"shared bias"}
    assert "<table" in section.html
    assert "&lt;" not in section.html


def test_a_better_rule_is_said_to_be():
    def made(gold):
        n = 8
        path = np.tile(np.linspace(0.0, 4.0, 9), (n, 1))
        noise = 0.01 * np.random.default_rng(len(gold)).normal(size=(n, 9))
        return {"divergence": path, "gold": path * 0 + noise + gold[0], "proxy": path, "loose": path, "length": path}

    class Fake(Published):
        def __init__(self, levels):
            super().__init__([grpo.study()], [])
            self.levels = levels

        def has(self, row, derived=""):
            return row["condition"] == "independent" and row["rule"] in self.levels

        def seeds_of(self, row):
            return tuple(range(8))

        def derived(self, row, name):
            return made([self.levels[row["rule"]]])[name]

    worse = shown.losses(Fake({"uard": 1.0, "median": 1.5, "mean": 0.5}))
    assert [x.what for x in worse if x.kind == "beaten"] == [
        *(f"median has more gold at KL {x}" for x in (0.5, 1, 2)),
        "median has more gold at the end",
    ]
    assert worse[0].ours.mean == pytest.approx(1.0, abs=0.02)
    assert worse[0].theirs.mean == pytest.approx(1.5, abs=0.02)
    assert [x for x in shown.losses(Fake({"uard": 1.0, "mean": 0.5})) if x.kind == "beaten"] == []
