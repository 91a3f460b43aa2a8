"""I have a CSV of ratings: which traps am I in, and what should be learned from?

Writes ratings.csv (three people rate 300 answers of a chat model, a tenth of which flatter the reward model), asks the
doctor, filters the rewards and writes filtered.csv. Needs nothing but `pip install uard`.
"""

import csv

import numpy as np

from uard import doctor
from uard.diagnosis import filtered
from uard.ratings import readers as logs

random = np.random.default_rng(0)
quality = random.normal(0.0, 1.0, 300)  # what an answer is worth; nobody but this script knows
flattery = random.random(300) < 0.1
reward = quality + 3.0 * flattery  # the reward model likes to be flattered
ratings = quality[:, None] + random.normal(0.0, [0.2, 0.3, 0.5], (300, 3))
ratings[random.random((300, 3)) < 0.1] = np.nan  # a tenth of the ratings was never given

with open("ratings.csv", "w", newline="") as file:
    writer = csv.writer(file)
    writer.writerow(["reward", "rating_ann", "rating_bob", "rating_cat"])
    for r, said in zip(reward, ratings, strict=True):
        writer.writerow([f"{r:.3f}", *("" if np.isnan(x) else f"{x:.3f}" for x in said)])

print(doctor("ratings.csv", "uard-operator"))  # the filter as printed: is it good enough here?
print()
print(doctor("ratings.csv"))  # and the one that we recommend?

log = logs.read("ratings.csv")
believed = filtered(log)
with open("filtered.csv", "w", newline="") as file:
    writer = csv.writer(file)
    writer.writerow(["reward", "believed"])
    writer.writerows(zip(log.reward, believed, strict=True))

print()
for name, column in (("reward", log.reward), ("believed", believed)):
    best = np.argsort(column)[-30:]
    share, worth = flattery[best].mean(), quality[best].mean()
    print(f"best 30 by {name:8}: {100 * share:.0f} % flattery, worth {worth:.2f} on average")
