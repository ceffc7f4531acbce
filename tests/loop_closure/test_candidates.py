"""Which pairs of sub-maps are tried: the best partners of each."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from uwblite.loop_closure.candidates import _best_per_submap


@given(st.integers(0, 10_000), st.integers(1, 4))
def test_every_submap_keeps_its_best_partners(seed, limit):
    """By a loop over sub-maps; a pair stays when it is among the best of either end, and is worth anything."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 40))
    a, b = rng.integers(0, 6, (2, count))
    worth = rng.permutation(count) - rng.integers(0, count + 1)
    kept = set()
    for one in (a, b):
        for submap in range(6):
            own = np.flatnonzero(one == submap)
            kept |= set(own[np.argsort(-worth[own])][:limit].tolist())
    assert _best_per_submap(a, b, worth, limit).tolist() == sorted(k for k in kept if worth[k] > 0.0)
