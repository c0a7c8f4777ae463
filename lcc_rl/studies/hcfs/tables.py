"""Tables of the HCFS study: comparison on the same windows, and the numbers of the paper."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
import torch

from lcc_rl.functional.hcfs import PlatoonReward
from lcc_rl.results import intervals

# What the paper prints in Table IV (case 1): Σ|e_v|, its std, Σ|jerk|, Σ reward.
TABLE_IV = {
    "CACC": (159.39, 0.22, 720.06, -59.70),
    "DDPG": (146.22, 0.16, 2344.60, -56.81),
    "HCFS": (25.26, 0.04, 192.19, -9.64),
}


def printed() -> pd.DataFrame:
    """Return Table IV as the paper prints it."""
    columns = ["strategy", "speed_error_sum", "speed_error_std", "jerk_sum", "reward"]
    return pd.DataFrame([(name, *row) for name, row in TABLE_IV.items()], columns=columns)


def weights() -> pd.DataFrame:
    """Compare the rewards printed in Table IV with those of its sums of errors and jerks."""
    reward = PlatoonReward()
    rows = [
        (name, error, jerk, total, float(reward(torch.tensor(error), torch.tensor(jerk))))
        for name, (error, _, jerk, total) in TABLE_IV.items()
    ]
    columns = ["strategy", "speed_error_sum", "jerk_sum", "reward_printed", "reward_computed"]
    return pd.DataFrame(rows, columns=columns)


def rewards(episodes: pd.DataFrame, strategy: str, case: str) -> pd.DataFrame:
    """Return Σ reward of every run, ``[runs × seeds]``; one column where nothing was learned."""
    rows = episodes[(episodes["strategy"] == strategy) & (episodes["case"] == case)]
    return rows.assign(training_seed=rows["training_seed"].fillna(-1)).pivot_table(
        index="profile", columns="training_seed", values="reward", aggfunc="sum"
    )


def win_rates(
    episodes: pd.DataFrame,
    of: str = "hcfs",
    against: Sequence[str] | None = None,
    case: str = "windows",
) -> pd.DataFrame:
    """Compare a strategy with others on the same windows.

    Args:
        episodes: rows of one or more evaluations.
        of: the strategy.
        against: those it is compared with; all others by default.
        case: name of the case.

    Returns:
        One row per other strategy: share of windows [%] in which ``of`` earns more (a tie counts
        half) and mean difference of Σ reward, the means over seeds with their 95 % intervals.
        Trained strategies are compared seed by seed.
    """
    own = rewards(episodes, of, case)
    names = [n for n in dict.fromkeys(episodes["strategy"]) if n != of]
    rows = []
    for name in names if against is None else against:
        other = rewards(episodes, name, case)
        if len(other.columns) == 1:
            other = pd.concat([other.iloc[:, 0]] * len(own.columns), axis=1, keys=own.columns)
        shared = own.columns.intersection(other.columns)
        difference = own[shared] - other[shared]
        wins = (difference > 1e-6) + 0.5 * (difference.abs() <= 1e-6)
        rows.append(
            {
                "strategy": of,
                "against": name,
                "trainings": len(shared),
                "windows": len(difference),
                **intervals.mean(wins.mean()).columns("wins_pct", 100.0),
                **intervals.mean(difference.mean()).columns("reward_gain"),
            }
        )
    return pd.DataFrame(rows)
