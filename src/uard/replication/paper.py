"""Every number that the paper prints about its tables, its grids and its figures, typed in once, with its tex line.

Rows are frozen; a ``Stat`` is the paper's "mean +- SD over 10 seeds". Ids (F2, G4, I1...) are those of
``paper/inventory.md``. Nothing is computed here: what follows from these numbers is in ``uard.replication.audit``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from uard._checks import InvalidValueError

VERSION = (
    "arXiv:2604.26360 in its version of 26 June 2026, whose abstract has nine baselines and 93.6 %. The first version (29 "
    "April 2026) has 93.7 % of trap visits there, counts no baselines, and admits a lower peak of the observed reward, where "
    "this one says that task performance stays competitive. The text of this one still prints 93.7 % (lines 1149, 1153, 1330)."
)

SEEDS = 10  # line 894
LAST_EPISODES = 100  # lines 924, 951
EPISODES = 500  # line 1002
GAMMA = 0.95  # lines 1002, 1891
LAMBDA = 2.0  # line 1886
ALPHA = BETA = 0.5  # line 1887
HEADS = 5  # line 1884
LEARNING_RATE = 0.1  # line 1002
EPSILON = (1.0, 0.995, 0.05)  # line 1002: start, factor per episode, floor
TRAP_REWARD, HARD_TRAP_REWARD = 4.0, 8.0  # lines 1916, 914
STEP_REWARD, GOAL_REWARD = -0.1, 10.0  # lines 1917, 1915
HORIZON = {6: 40, 8: 60, 10: 80}  # lines 901, 1918
HORIZON_IN_TEXT = 40  # line 1002
GOAL_IN_APPENDIX = (9, 9)  # line 1915, whatever the grid's size
SIGMA_H_AT_TRAP = 1.247  # line 1960
APPENDIX_RATER_SD = {"trap": (0.1, 0.3, 1.0), "elsewhere": (0.1, 0.3, 0.2)}  # lines 1935-1937
NOISE_LEVELS = (0.0, 0.1, 0.2, 0.3)  # line 1998
CPO_COST_LIMIT = 0.5  # line 1898


class Stat(NamedTuple):
    """Mean and standard deviation over the seeds, as printed."""

    mean: float
    sd: float


@dataclass(frozen=True)
class ScaleRow:
    """A row of Table 2 (F2): trap hits "during the final 100 episodes" by grid size."""

    size: int
    traps: int
    uard: Stat
    baseline: Stat
    line: int


TABLE_2 = (
    ScaleRow(6, 1, Stat(0.0, 1.0), Stat(16.2, 2.1), 933),
    ScaleRow(8, 2, Stat(14.0, 3.0), Stat(111.0, 8.0), 934),
    ScaleRow(10, 3, Stat(10.0, 4.0), Stat(141.0, 12.0), 935),
)


@dataclass(frozen=True)
class BaselineRow:
    """A row of Table 3 (F3): 10x10, "final 100 episodes"; mean reward, trap visits, reduction against DQN in %."""

    method: str
    reward: Stat
    visits: Stat
    reduction: float
    line: int


TABLE_3 = (
    BaselineRow("DQN", Stat(165.87, 2.23), Stat(4289.50, 54.36), 0.0, 961),
    BaselineRow("CQL", Stat(169.03, 0.99), Stat(4366.60, 24.03), -1.8, 963),
    BaselineRow("CPO", Stat(166.35, 1.54), Stat(4301.10, 37.57), -0.3, 964),
    BaselineRow("TRPO", Stat(168.72, 0.80), Stat(4359.00, 19.51), -1.6, 965),
    BaselineRow("UARD", Stat(1.23, 0.69), Stat(274.00, 16.83), 93.6, 967),
)


@dataclass(frozen=True)
class PerformanceRow:
    """A row of Table 4 (F4): 6x6, "at episode 500"; ``gap`` is None where the table prints "Significant"."""

    agent: str
    true_return: Stat
    observed_return: Stat
    visits: Stat
    gap: Stat | None
    line: int


TABLE_4 = (
    PerformanceRow("Baseline", Stat(-19.8, 10.3), Stat(57.8, 8.4), Stat(16.2, 2.1), None, 1124),
    PerformanceRow("Multi-Head", Stat(-27.7, 23.7), Stat(42.1, 11.5), Stat(14.5, 3.5), None, 1125),
    PerformanceRow("UARD", Stat(-4.0, 0.6), Stat(9.1, 1.3), Stat(0.0, 1.0), Stat(3.2, 0.8), 1126),
)


@dataclass(frozen=True)
class AblationRow:
    """A row of Table 5 (F5): which parts are there, and trap hits."""

    variant: str
    sigma_m: bool
    sigma_h: bool
    discounting: bool
    visits: Stat
    line: int


TABLE_5 = (
    AblationRow("Baseline", False, False, False, Stat(16.2, 2.1), 1247),
    AblationRow("Ablation I", True, False, False, Stat(14.8, 3.2), 1248),
    AblationRow("Ablation II", True, True, False, Stat(13.5, 2.8), 1249),
    AblationRow("UARD-lite", True, False, True, Stat(4.0, 1.5), 1250),
    AblationRow("Human-only", False, True, True, Stat(9.0, 2.3), 1251),
    AblationRow("UARD", True, True, True, Stat(0.0, 1.0), 1252),
)


BASELINES = {
    "DQN": ("F3",),
    "Ensemble-DQN": (),
    "CQL": ("F3",),
    "CPO": ("F3",),
    "TRPO": ("F3",),
    "SAC": ("G6", "G7", "G11"),
    "EDAC": ("G14",),
    "SUNRISE": ("G15",),
    "PPO": ("G6", "G7", "G11", "G13"),
}  # line 49: the nine, and the tables and figures in which each is named; G16 names none but "all baselines"


class Hyperparameter(NamedTuple):
    """A row of Table 6 (F6), as printed."""

    grid: str
    mujoco: str
    line: int


TABLE_6 = {
    "Ensemble Size (N)": Hyperparameter("5", "5", 1884),
    "Annotators (K)": Hyperparameter("3", "3", 1885),
    "Skepticism (lambda)": Hyperparameter("2.0", "2.0", 1886),
    "Weights (alpha, beta)": Hyperparameter("0.5, 0.5", "0.5, 0.5", 1887),
    "Learning Rate": Hyperparameter("0.1", "3e-4", 1890),
    "Discount Factor (gamma)": Hyperparameter("0.95", "0.99", 1891),
    "Batch Size": Hyperparameter("64", "256", 1892),
    "Replay Buffer": Hyperparameter("10k", "1M", 1893),
    "Training Duration": Hyperparameter("500 episodes", "1M steps", 1894),
    "CQL alpha": Hyperparameter("1.0", "1.0", 1897),
    "CPO Cost Limit": Hyperparameter("0.5", "0.1", 1898),
    "TRPO delta (KL)": Hyperparameter("0.01", "0.01", 1899),
}


@dataclass(frozen=True)
class PrintedTest:
    """A statistical test that the paper reports; None where it prints no number."""

    what: str
    line: int
    t: float | None = None
    df: int | None = None
    p_below: float | None = None


TESTS = {
    "I1": PrintedTest("two-sample t-test of trap visits, UARD against the baseline (Table 4)", 1133, 29.15, 18, 0.001),
    "I2": PrintedTest("improvement in true return stability; test not named", 1137, p_below=0.01),
    "I3": PrintedTest("pairwise t-tests of UARD against each baseline (Table 3), Bonferroni", 1225, p_below=0.001),
}


class Quoted(NamedTuple):
    """A number in the running text: value, tex line, what it is said of."""

    value: float
    line: int
    what: str


PERCENT = {
    "hacking": Quoted(93.6, 30, "reduction of hacking 'across discrete ... and continuous control benchmarks'"),
    "visits-6x6": Quoted(93.7, 1149, "reduction of trap visits per episode on 6x6, and 'up to' in the conclusion"),
    "hits-8x8": Quoted(87.4, 944, "reduction of trap hits, Table 2, 8x8"),
    "hits-10x10": Quoted(92.9, 947, "reduction of trap hits, Table 2, 10x10"),
    "gap": Quoted(95.9, 1171, "reduction of the alignment gap, 77.6 to 3.2"),
    "stability": Quoted(91.7, 1947, "improvement in policy stability"),
    "noise-rise": Quoted(277.0, 2025, "rise of the baselines' violations from 0 % to 30 % noise"),
    "noise-lower": Quoted(98.3, 2033, "UARD's violations below the baselines' at 30 % noise"),
    "exploits": Quoted(92.0, 2111, "fewer exploit activations than EDAC"),
}

TEXT = {
    "baseline gap": Quoted(77.6, 1171, "|57.8 - (-19.8)|"),
    "transition episode": Quoted(400, 1143, "sharp transition of UARD's reward curve towards the goal"),
    "avoidance episode": Quoted(200, 1149, "trap visits near zero by then"),
    "seed exceeds": Quoted(40, 2028, "violations of individual seeds at 30 % noise"),
    "lambda too small": Quoted(2, 1971, "below it, occasional hacking"),
    "lambda avoids": Quoted(5, 1973, "traps avoided consistently"),
    "lambda too large": Quoted(10, 1973, "above it, over-conservative"),
    "overhead low": Quoted(2, 1308, "training cost against a single head, at least"),
    "overhead high": Quoted(3, 1308, "training cost against a single head, at most"),
    "GPU hours": Quoted(150, 1410, "RTX 3090"),
    "kWh low": Quoted(30, 1411, "energy, at least"),
    "kWh high": Quoted(45, 1411, "energy, at most"),
    "noise in discussion": Quoted(0.2, 1294, "noise level of the robustness claim"),
    "Walker2d objective": Quoted(110, 987, "return of stable locomotion"),
    "Hopper objective": Quoted(42, 1923, "return of stable locomotion"),
    "Walker2d reference": Quoted(108.3, 995, "mean return of the reference policy, SD 4.2"),
    "Hopper reference": Quoted(41.1, 1926, "mean return of the reference policy, SD 3.7"),
}

Number = float | tuple[float, float]


@dataclass(frozen=True)
class Figure:
    """What a figure must show. No figure file exists: caption and text are all there is.

    Attributes:
        line: Line of the caption.
        shows: Axes and series.
        numbers: Single numbers, or (low, high) ranges (for ``Stat`` mean and SD), by name.
    """

    line: int
    shows: str
    numbers: dict[str, Number | Stat] = field(default_factory=dict)

    def number(self, name: str) -> float:
        """Return a single number."""
        value = self.numbers[name]
        if isinstance(value, tuple):
            raise InvalidValueError(name, value, "a single number")
        return float(value)

    def range(self, name: str) -> tuple[float, float]:
        """Return both ends of a range."""
        value = self.numbers[name]
        if not isinstance(value, tuple):
            raise InvalidValueError(name, value, "a range")
        return value[0], value[1]

    def stat(self, name: str) -> Stat:
        """Return mean and standard deviation."""
        return Stat(*self.range(name))


FIGURES = {
    "G1": Figure(347, "architecture: sigma_m and sigma_h enter the filter, which gives J"),
    "G2": Figure(876, "weight against uncertainty: reciprocal, exponential, linear"),
    "G3": Figure(1108, "reward against episode, UARD and baseline", {"trap": 4.0, "goal": 10.0}),
    "G4": Figure(
        1153,
        "trap visits per episode against episode",
        {"baseline up to": 16.0, "variants": (11.0, 18.0), "UARD": Stat(0.0, 1.0)},
    ),
    "G5": Figure(
        1163, "observed and true return of the baseline", {"observed above": 50.0, "baseline true": (-19.8, -9.5)}
    ),
    "G6": Figure(1181, "Hopper-v4: PPO and SAC drift from the target, UARD stays", {"target": 42.0}),
    "G7": Figure(1191, "Walker2d-v4: baselines spike, UARD stays", {"baselines": 350.0, "UARD": 110.0}),
    "G8": Figure(
        1955,
        "true return against episode",
        {"baseline": (-48.6, -4.0), "multi-head lowest": -51.4, "UARD": -4.0},
    ),
    "G9": Figure(1964, "sigma_m falls with training, sigma_h stays high at (3,3)", {"sigma_h": SIGMA_H_AT_TRAP}),
    "G10": Figure(1990, "return round a state perturbation", {"perturbation": 5.0, "step": 500.0}),
    "G11": Figure(
        2006,
        "safety violations against noise of the ratings, mean, SD and seeds",
        {
            "baseline at 0": Stat(6.2, 7.1),
            "baseline at 30": Stat(23.4, 8.3),
            "UARD at 0": Stat(0.3, 0.6),
            "UARD at 30": Stat(0.4, 0.8),
        },
    ),
    "G12": Figure(2063, "effective reward of naive, Caution and UARD in a Hacking Region; lambda_t rises there"),
    "G13": Figure(2078, "advantage against reward perturbation, UARD and PPO"),
    "G14": Figure(
        2100,
        "confidence-adjusted reward of EDAC and UARD, and their gap",
        {"UARD below": 0.3, "gap above": 0.1, "spikes": 3.0},
    ),
    "G15": Figure(
        2146,
        "confidence-adjusted reward of SUNRISE and UARD, and their gap",
        {"UARD below": 0.3, "SUNRISE above": 1.4, "gap": 1.6, "ratio above": 5.0},
    ),
    "G16": Figure(2193, "observed return of all methods against episode; UARD stays low throughout"),
}
