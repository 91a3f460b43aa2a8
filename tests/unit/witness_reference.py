"""The model of who tells the truth as it was first written down, in plain NumPy and SciPy: what ``witness`` must give.

One thing is mended: probabilities of intervals are differences in the lower tail, where they lose no digits. Silent
raters are unknown to it, and likelihoods are products, which underflow for many raters.
"""

import numpy as np
from scipy.special import ndtr

PRIOR = dict(pi=0.2, npi=2.0, phi=0.9, nphi=5.0, q=0.3, eps=1e-4, far=1e-12, rho=0.5, nu=4.0, slack=0.1, u=0.05)


def pdf(d, v):
    return np.exp(-0.5 * d * d / v) / np.sqrt(2 * np.pi * v)


def between(a, b):
    """P(a < x < b) of a standard normal x."""
    flip = a + b > 0
    return ndtr(np.where(flip, -a, b)) - ndtr(np.where(flip, -b, a))


def variance(n, m2, us, P=PRIOR):
    """Variance of what a rater's mean says; inf where he never spoke or is no witness."""
    s2 = (P["nu"] * us["s2"] + m2) / (P["nu"] + np.maximum(n - 1, 0))
    v = (s2 / np.maximum(n, 1) + us["tau2"] + us["fl"]) / us["g2"]
    return np.where((n > 0) & us["witness"], v, np.inf)


def parts(z, v0, r, us, P=PRIOR):
    """Likelihood of an honest proxy; and of a lie, over [0] or under [1], with the truth's first two moments."""
    here = np.isfinite(v0)
    v0, r = np.where(here, v0, 1.0), r[:, None]
    z, q, eps, fl = np.where(here, z, r), P["q"], P["eps"], us["fl"]
    rng = us["hi"] - us["lo"] + us["scale"]

    def one(x):
        return np.where(here, x, 1.0).prod(1)

    def at(R):
        return v0 + P["slack"] ** 2 * (R - us["typical"]) ** 2

    vr, top = at(r) + fl, np.maximum(r, z.max(1, keepdims=True))
    L0 = one((1 - eps) * pdf(z - r, vr) + eps / rng)
    W = np.zeros((2, len(z)))
    B, C = W.copy(), W.copy()

    def wrong(R, v):  # a rater who errs: between truth and proxy (or beyond it, as others do), or repeats the proxy
        a, b = np.where(r > R, R, r), np.where(r > R, top, R)
        w, sd = b - a, np.sqrt(v)
        wide = between((a - z) / sd, (b - z) / sd) / np.where(w > 1e-9, w, 1)
        return 0.5 * np.where(w > 1e-9, wide, pdf(z - R, v)) + 0.5 * pdf(z - r, vr)

    def out(R):  # nobody errs away from the proxy
        return np.where(np.where(r > R, z < R, z > R), P["far"], 1.0) * eps / rng

    for j in range(z.shape[1]):  # hypothesis: rater j tells the truth
        R, V, m = z[:, j : j + 1], v0[:, j : j + 1], np.ones_like(r)
        for _ in range(2):  # ... together with all who agree with him
            v = at(R)
            a = (1 - q - eps) * pdf(z - R, v)
            h = np.where(here, a / (a + q * wrong(R, v) + out(R) + 1e-300), 0.0)
            p = (h / v).sum(1, keepdims=True)
            ok = p > 0
            d = np.where(ok, p, 1)
            R = np.where(ok, (h * z / v).sum(1, keepdims=True) / d, R)
            V, m = np.where(ok, 1 / d, V), np.where(ok, h.sum(1, keepdims=True), m)
        v = at(R)
        L = one((1 - q - eps) * pdf(z - R, v) + q * wrong(R, v) + out(R))
        R, V, m = R[:, 0], V[:, 0], np.maximum(m[:, 0], 1)
        over = r[:, 0] > R
        room = np.where(over, np.maximum(r[:, 0] - us["lo"], 0), np.maximum(us["hi"] - r[:, 0], 0))
        prior = 1 / (room + us["scale"])
        wt = np.where(here[:, j] & (12 * v0[:, j] <= rng**2), L * prior * np.sqrt(2 * np.pi * V) / m, 0.0)
        for s, mask in ((0, over), (1, ~over)):
            W[s] += wt * mask
            B[s] += wt * mask * R
            C[s] += wt * mask * (R * R + V)
    return L0, W, B, C


def mix(r, L0, W, B, C, us, rho):
    f = us["phi"]
    w1, b1, c1 = (f * x[0] + (1 - f) * x[1] for x in (W, B, C))
    ok = w1 > 0
    d = np.where(ok, w1, 1)
    b = np.where(ok, b1 / d, r)
    s2 = np.where(ok, np.maximum(c1 / d - b * b, 0), 0)
    a0, a1 = (1 - us["pi"]) * L0, us["pi"] * w1
    w = a0 / (a0 + a1)
    sd = np.sqrt(w * (1 - w) * (r - b) ** 2 + (1 - w) * s2)
    return b + w * (r - b) - rho * sd, w, b, sd


def spammers(n, mean, us):
    """Answers that do not depend on what is rated: by which the variances are divided."""
    heard, K, scale = n > 0, n.shape[1], us["scale"]
    Bk, U = np.zeros(K), np.full(K, np.inf)
    for k in range(K):
        i = heard[:, k]
        if i.sum() < 3:
            continue
        e = us["s2"][k] / n[i, k]
        w, y = 1 / (e + scale**2), mean[i, k]
        c = (w * y).sum() / w.sum()
        Bk[k] = (w * ((y - c) ** 2 - e)).sum() / w.sum()
        U[k] = Bk[k] + 2 * np.sqrt((2 * w * w * e * e).sum()) / w.sum()
    mb = np.median(np.maximum(Bk, 0))
    return np.clip(U / mb, 1e-4, 1) if mb > 0 else np.ones(K)


def fit(n, mean, m2, r, statistics, P=PRIOR):
    """What is usual; noise, bias, idiosyncrasy and who is heard are those of the pooled rule's reference."""
    us = dict(scale=statistics["scale"], fl=statistics["floor"], typical=statistics["typical"], s2=statistics["s2"])
    us |= dict(bias=statistics["bias"], tau2=statistics["tau2"], witness=statistics["heard"])
    z, N = np.where(n > 0, mean - us["bias"], np.nan), len(n)
    us["lo"], us["hi"] = min(np.nanmin(z), r.min()), max(np.nanmax(z), r.max())
    us["g2"] = spammers(n, mean, us)
    us["pi"], us["phi"] = P["pi"], P["phi"]
    L0, W, B, C = parts(np.where(n > 0, z, 0), variance(n, m2, us, P), r, us, P)
    for _ in range(15):
        a, m, p = (1 - us["pi"]) * L0, us["pi"] * us["phi"] * W[0], us["pi"] * (1 - us["phi"]) * W[1]
        t = a + m + p
        sm, sp = (m / t).sum(), (p / t).sum()
        us["pi"] = (P["npi"] * P["pi"] + sm + sp) / (P["npi"] + N)
        us["phi"] = (P["nphi"] * P["phi"] + sm) / (P["nphi"] + sm + sp)
    us["b0"] = np.median(mix(r, L0, W, B, C, us, P["rho"])[0])
    return us


def reward(n, mean, m2, r, us, P=PRIOR):
    """The reward to learn from, its weight, the anchor, and the posterior deviation."""
    v = variance(n, m2, us, P)
    x, w, b, sd = mix(r, *parts(mean - us["bias"], v, r, us, P), us, P["rho"])
    un = np.minimum(r, us["b0"] + P["u"] * (r - us["b0"]))
    rated = np.isfinite(v).any(1)
    return np.where(rated, x, un), np.where(rated, w, P["u"]), b, sd
