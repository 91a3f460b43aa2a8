"""The pooled rule as it was first written down, for one panel in plain NumPy: what ``uard`` must agree with."""

import numpy as np

PI, SLACK, TAUS, SES, RISK, UNRATED, FLOOR = 0.2, 0.1, 1.0, 0.5, 1.0, 0.05, 0.01


def noise(n, mean, m2, scale):
    """Per rater, the variance of one answer, shrunk towards that of all: (K,)."""
    df = np.maximum(n - 1, 0)
    pool = (m2.sum() + 0.01 * scale**2) / (df.sum() + 1)
    return (m2.sum(0) + 3 * pool) / (df.sum(0) + 3)


def bias(n, mean, r, s2, scale):
    """Per rater, a Huber mean of what he says beyond the reward, which lies at few state-actions: (K,)."""
    out = np.zeros(n.shape[1])
    for k in range(n.shape[1]):
        i = n[:, k] > 0
        if not i.any():
            continue
        d, e = (mean[:, k] - r)[i], s2[k] / n[i, k] + 0.01 * scale**2
        # Differs from the first version: where lies are the larger part, the median takes them for a bias.
        b = 0.0 if (np.abs(d) <= 6 * np.sqrt(e)).mean() >= 0.1 else np.median(d)
        for _ in range(5):
            u = np.abs(d - b) / np.sqrt(e)
            w = np.where(u > 6, 0.0, np.minimum(1.0, 2.0 / np.maximum(u, 1e-9))) / e
            b = (w * d).sum() / w.sum() if w.sum() > 0 else b
        out[k] = b * i.sum() / (i.sum() + 4.0)
    return out


def idiosyncrasy(n, mean, r, s2, b, floor):
    """Per rater, the variance of what he says that neither noise nor what the others say explains: (K,)."""
    K = n.shape[1]
    out = np.zeros(K)
    for k in range(K):
        rows = np.flatnonzero(n[:, k] > 0)
        if not len(rows):
            continue
        others = [j for j in range(K) if j != k]
        z = np.where(n[:, others] > 0, mean[:, others] - b[others], np.nan)[rows]
        centre = np.nanmedian(np.column_stack([r[rows], z]), 1)
        heard = (n[:, others] > 0)[rows]
        of_others = np.where(heard, s2[others] / np.maximum(n[:, others], 1)[rows], 0.0).sum(1)
        nv = s2[k] / n[rows, k] + of_others / np.maximum(heard.sum(1), 1) ** 2 + floor
        d2 = (mean[rows, k] - centre - b[k]) ** 2
        lo, hi = 0.0, d2.max() / 0.455  # the median of a chi-squared variable with one degree of freedom
        if 2 * (d2 > 0.455 * nv).sum() <= len(d2):
            continue
        for _ in range(25):
            mid = (lo + hi) / 2
            lo, hi = (mid, hi) if 2 * (d2 > 0.455 * (nv + mid)).sum() > len(d2) else (lo, mid)
        out[k] = hi
    return out


def fit(n, mean, m2, r):
    """Statistics of the panel over distinct rated state-actions."""
    scale = r.std() or 1.0
    floor = (FLOOR * scale) ** 2
    s2 = noise(n, mean, m2, scale)
    b = bias(n, mean, r, s2, scale)
    said = np.where(n > 0, mean, np.nan)
    panel = dict(
        scale=scale,
        floor=floor,
        s2=s2,
        bias=b,
        tau2=idiosyncrasy(n, mean, r, s2, b, floor),
        typical=np.median(r),
        span=max(np.nanmax(said), r.max()) - min(np.nanmin(said), r.min()) + scale,
        heard=np.sqrt(s2) <= 2 * np.median(np.sqrt(s2)) if len(s2) > 2 else np.ones(len(s2), bool),
        usual=0.0,
    )
    panel["usual"] = np.median(reward(n, mean, m2, r, panel)[0])
    return panel


def reward(n, mean, m2, r, panel, doubt=0.0):
    """The reward to learn from (N,), w (N,), b (N,), and tau (N,), the contest beyond noise: sigma_h."""
    here = (n > 0) & panel["heard"]
    z = np.where(here, mean - panel["bias"], 0.0)
    one = (4 * panel["s2"] + m2) / (4 + np.maximum(n - 1, 0))
    v = one / np.maximum(n, 1) + panel["tau2"] + 2 * panel["floor"] + (SLACK * (r - panel["typical"])[:, None]) ** 2
    p = np.where(here, 1 / v, 0.0)
    K, sw = here.sum(1), p.sum(1)
    safe = np.where(sw > 0, sw, 1.0)
    m = (p * z).sum(1) / safe
    Q = (p * (z - m[:, None]) ** 2).sum(1)
    denominator = sw - (p * p).sum(1) / safe
    tau2 = np.where(K > 1, np.maximum(Q - (K - 1), 0) / np.where(denominator > 0, denominator, 1.0), 0.0)
    q = np.where(here, 1 / (v + tau2[:, None]), 0.0)
    sr = np.where(q.sum(1) > 0, q.sum(1), 1.0)
    mr = (q * z).sum(1) / sr
    apart = -0.5 * np.where(here, np.log1p(tau2[:, None] / v) + q * (z - mr[:, None]) ** 2, 0.0).sum(1)
    apart -= 0.5 * np.log1p(panel["span"] ** 2 * sr)
    centred = -0.5 * (p * (z - r[:, None]) ** 2).sum(1)
    odds = np.clip(apart - centred + np.log(PI / (1 - PI)), -50, 50)
    w = 1 / (1 + np.exp(odds))
    # Differs from the first version: nobody is taken to mean less than the lowest that was said.
    lowest = np.where(K > 0, np.where(here, z, np.inf).min(1), 0.0)
    b = np.maximum(mr - TAUS * np.sqrt(tau2), lowest) - SES / np.sqrt(sr)
    x = b + w * (r - b) - RISK * np.sqrt(w * (1 - w)) * np.abs(r - b)
    unrated = np.minimum(r, panel["usual"] + UNRATED * (r - panel["usual"])) - RISK * doubt
    rated = K > 0
    return np.where(rated, x, unrated), np.where(rated, w, UNRATED), b, np.sqrt(tau2)
