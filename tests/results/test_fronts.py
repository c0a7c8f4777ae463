"""Controllers compared at the same share of the time beyond a limit."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from lcc_rl.errors import ResultsError
from lcc_rl.results.fronts import ENERGY, SHARE, energy_at, points, saving_at

NETWORK, RULE = ("alcc", "network"), ("alcc", "idm")


def made(windows: int = 12, seeds: int = 3, saved: float = 0.05, noise: float = 0.0):
    """Two fronts, energy = level − 1000 · share; the network's level is lower by ``saved``."""
    generator = np.random.default_rng(0)
    level = 100.0 + 20.0 * generator.standard_normal(windows)
    rows = []
    for (variant, policy), factor in ((NETWORK, 1.0 - saved), (RULE, 1.0)):
        for limit in (0.01, 0.02, 0.03):
            share = limit * (0.5 if policy == "idm" else 0.8)  # missed less than allowed
            for seed in range(seeds):
                for window in range(windows):
                    drawn = noise * generator.standard_normal()
                    energy = factor * (level[window] - 1000.0 * share) + drawn
                    rows.append((variant, policy, limit, seed, window, energy, share))
    names = ["variant", "policy", "limit", "training_seed", "profile_id", ENERGY, SHARE]
    return pd.DataFrame(rows, columns=names)


def test_energy_is_read_between_the_limits_and_beyond_the_last_but_not_before_the_first() -> None:
    energy, share = np.array([90.0, 100.0]), np.array([0.02, 0.01])
    assert energy_at(energy, share, 0.0125) == pytest.approx(97.5)
    assert np.isnan(energy_at(energy, share, 0.005))
    assert energy_at(energy, share, 0.03) == 90.0  # a limit that is always kept


def test_saving_is_read_at_the_same_share_not_at_the_same_limit() -> None:
    windows = made()
    found = saving_at(windows, NETWORK, RULE, 0.012)
    assert found.value == pytest.approx(0.05)
    # Every window saves as much: nothing is left to chance.
    assert found.low == pytest.approx(0.05)
    assert found.high == pytest.approx(0.05)
    back = saving_at(windows, RULE, NETWORK, 0.012)
    assert back.value == pytest.approx(1.0 - 1.0 / 0.95)
    # At the same limit they miss different shares.
    table = points(windows).set_index(["policy", "limit"])
    assert table.loc[("idm", 0.02), SHARE] == pytest.approx(0.01)
    assert table.loc[("idm", 0.02), "seeds"] == 3


def test_the_interval_covers_nothing_where_there_is_nothing() -> None:
    found = saving_at(made(saved=0.0, noise=2.0), NETWORK, RULE, 0.012)
    assert found.low < 0.0 < found.high
    assert found.high - found.low < 0.03
    missed = saving_at(made(), NETWORK, RULE, 0.001)
    assert np.isnan([missed.value, missed.low, missed.high]).all()


def test_a_missing_training_is_named() -> None:
    windows = made()
    gone = windows[
        ~((windows.policy == "idm") & (windows.limit == 0.02) & (windows.profile_id < 2))
    ]
    with pytest.raises(ResultsError, match="alcc idm: 102 rows; expected every window and seed"):
        saving_at(gone, NETWORK, RULE, 0.012)
    with pytest.raises(ResultsError, match="there are no trainings of alcc acc"):
        saving_at(windows, NETWORK, ("alcc", "acc"), 0.012)
