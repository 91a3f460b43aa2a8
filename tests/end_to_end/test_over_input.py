"""No command writes over what it reads."""

from contextlib import closing

import pytest

from uard.cli.app import main
from uard.lab.execution.store import Store

LOG = "reward,rating_a,rating_b\n1,1,1.1\n0,0,0.1\n"


@pytest.mark.parametrize("command", ["doctor {0} --json {0}", "doctor {0} --json {1}"])
def test_the_doctor_spares_its_log(tmp_path, capsys, command):
    log, link = tmp_path / "log.csv", tmp_path / "link.csv"
    log.write_text(LOG)
    link.symlink_to(log)
    with pytest.raises(SystemExit) as stopped:
        main(command.format(log, link).split())
    assert stopped.value.code == 2
    assert "which it would destroy" in capsys.readouterr().err.replace("\n", "")
    assert log.read_text() == LOG


@pytest.mark.parametrize(
    "command",
    [
        "leaderboard --store {0} --out {0}",
        "run TrapGrid6 --episodes 5 --seeds 1 --store {0} --json {0}",
        "run TrapGrid6 --episodes 5 --seeds 2 --store {0} --log {0}",
        "status --store {0} --json {0}",
        "compare {0} {0} --json {0}",
    ],
)
def test_stores_are_spared(tmp_path, capsys, command):
    store = tmp_path / "s.sqlite"
    main(f"run TrapGrid6 --episodes 5 --seeds 1 --store {store} --json -".split())
    with pytest.raises(SystemExit) as stopped:
        main(command.format(store).split())
    assert stopped.value.code == 2
    assert "which it would" in capsys.readouterr().err.replace("\n", " ")
    with closing(Store(store, readonly=True)) as kept:
        assert kept.count() == (1, 1)
