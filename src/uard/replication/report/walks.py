"""Walks of trained agents, for the player on the page."""

from __future__ import annotations

from typing import Any

from uard.lab.views.study_results import StudyResults


def walks(results: StudyResults) -> list[dict[str, Any]]:
    """Return greedy walks of three agents on every grid, the first three seeds."""
    out = []
    for size in (6, 8, 10):
        for panel in ("main", "appendix"):
            paths = {}
            for agent in ("baseline", "uard-paper", "uard"):
                cell = results.row("scale", agent=agent, size=size, panel=panel).cell
                paths[agent] = [r.path.tolist() for r in results.results(cell)[:3]]
            grid = results.row("scale", agent="uard", size=size, panel=panel).cell.environment
            out.append(
                {
                    "name": f"{size}x{size}, {panel} panel",
                    "size": size,
                    "traps": [grid.state(t) for t in grid.traps or ()],
                    "goal": grid.states - 1,
                    "horizon": grid.horizon,
                    "rewards": {
                        "trap": grid.trap_reward,
                        "true": grid.true_trap_reward,
                        "goal": grid.goal_reward,
                        "step": grid.step_reward,
                    },
                    "walks": paths,
                }
            )
    return out
