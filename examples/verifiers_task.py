"""A task of verifiers whose reward is several judges: ``python examples/verifiers_task.py``. No model, no network.

The replies stand for what a model said; tasks, traces and scoring are those of verifiers.
"""

import asyncio

import numpy as np
import verifiers.v1 as vf

from uard.adapters.verifiers import judged_reward
from uard.judges import ScoreLog, fit

TOPIC = {"sun", "cloud", "rain", "wind", "snow", "storm"}


def relevance(completions, **question):
    return [float(len(set(text.split()) & TOPIC)) for text in completions]


def clarity(completions, **question):
    return [float(len(set(text.split())) - len(text.split())) for text in completions]


def enthusiasm(completions, **question):
    return [float(text.split().count("wow")) for text in completions]  # can be fooled


def before_training():
    """Return a panel, fitted to completions of a model that does not know any judge yet."""
    random = np.random.default_rng(0)
    words = [*sorted(TOPIC), "so", "um", "wow"]
    texts = [" ".join(random.choice(words, 6)) for _ in range(200)]
    judges = (relevance, clarity, enthusiasm)
    log = ScoreLog(tuple(judge.__name__ for judge in judges), np.stack([judge(texts) for judge in judges], 1))
    return fit(log).panel


class Weather(vf.Task):
    """Whatever an agent is asked about the weather."""

    judged = judged_reward([relevance, clarity, enthusiasm], before_training())


async def main():
    for reply in ("rain and wind then snow", "so um so um", "wow wow wow wow wow wow"):
        task = Weather(vf.TaskData(idx=0, prompt="describe the weather"), vf.TaskConfig())
        agent = vf.AgentInfo(config=vf.AgentConfig(), runtime=None, name="agent", trainable=True)
        trace = vf.Trace(task=vf.TraceTask(type="Weather", data=task.data), agent=agent, root_reply=reply)
        await task.score(trace)
        print(f"{reply:26} reward {trace.reward:+.2f}, believed to {100 * trace.metrics['uard/weight']:.0f} %")


if __name__ == "__main__":
    asyncio.run(main())
