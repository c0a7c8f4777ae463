"""Tables of the HCFS study with the paper's numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import torch

from lcc_rl.data.leaders import WHOLE_RECORD
from lcc_rl.evaluation.cases import WINDOW_CASES
from lcc_rl.functional.hcfs import PlatoonReward
from lcc_rl.results import intervals
from lcc_rl.results.names import in_words
from lcc_rl.results.platoons import PER_RUN, case_table
from lcc_rl.results.windows import DRIVE, START, drives_of

LEARNED = "ddpg"  # variant of the hybrid's policy
# Numbers of Table IV (case 1): Σ|e_v|, its std, Σ|jerk|, Σ reward.
TABLE_IV = {
    "CACC": (159.39, 0.22, 720.06, -59.70),
    "DDPG": (146.22, 0.16, 2344.60, -56.81),
    "HCFS": (25.26, 0.04, 192.19, -9.64),
}
CASE_3 = {"CACC": -4.78, "DDPG": -5.81, "HCFS": -1.90}  # Σ reward in Table VI
# Headings of :func:`win_rates`.
GAINED = {
    f"{old}{end}": f"{new}{end}"
    for old, new in {"wins_pct": "HCFS wins_pct", "gain_pct": "HCFS gains_pct"}.items()
    for end in intervals.BOUNDED
}
RUN = ["strategy", "training_seed", "case", "profile", "run_id"]
SUMS = ["speed_error_sum", "speed_error_squares", "jerk_sum", "jerk_squares", "reward", "frames"]
SUMS += ["collided", *PER_RUN]
LARGEST_COLUMNS = ["max_gap_error_m", "peak_jerk_mps3", "energy_ratio"]
# Strategies of runs behind other sources of leaders.
STABLE = ("cacc tuned", "deadbeat", LEARNED, "hcfs", "hcfs between", "hcfs first")
LEADERS = {  # names of sources of leaders in tables
    "traffic": "I-80",
    "cycles": "cycles at half speed",
    "fast_cycles": "cycles",
    "openacc_3": "OpenACC",
    "openacc_10": "OpenACC",
    "i24": "I-24",
    "everyday": "everyday drives",
}


def per_run(episodes: pd.DataFrame) -> pd.DataFrame:
    """Sum the rows of each run's vehicles; :func:`case_table` also accepts the result."""
    kinds = {**dict.fromkeys(SUMS, "sum"), **dict.fromkeys(LARGEST_COLUMNS, "max")}
    kinds |= {"min_gap_m": "min", "learned_share": "mean", "drawn_energy_kj_per_km": "mean"}
    kinds |= {name: "first" for name in (DRIVE, START) if name in episodes}
    return episodes.groupby(RUN, sort=False, dropna=False, as_index=False).agg(kinds)


def rounded(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table with the precision of figures."""
    numbers = frame.select_dtypes("number").columns
    return frame.assign(**frame[numbers].astype("float32").round(3))


def printed() -> pd.DataFrame:
    """Return Table IV of the paper."""
    columns = ["strategy", "speed_error_sum", "speed_error_std", "jerk_sum", "reward"]
    return pd.DataFrame([(name, *row) for name, row in TABLE_IV.items()], columns=columns)


def weight_table() -> pd.DataFrame:
    """Compare the rewards in Table IV with those computed from its sums of errors and jerks."""
    reward = PlatoonReward()
    rows = [
        (name, error, jerk, total, float(reward(torch.tensor(error), torch.tensor(jerk))))
        for name, (error, _, jerk, total) in TABLE_IV.items()
    ]
    columns = ["strategy", "speed_error_sum", "jerk_sum", "reward_printed", "reward_computed"]
    return pd.DataFrame(rows, columns=columns)


def reward_per_seed(
    episodes: pd.DataFrame, strategy: str, case: str, of: str = "reward"
) -> pd.DataFrame:
    """Return a sum for every run, ``[runs × seeds]``; one column without training.

    The index names the run's window, drive and start, if known; without drives each window counts
    as one.
    """
    rows = episodes[(episodes["strategy"] == strategy) & (episodes["case"] == case)]
    seeds, drives = rows["training_seed"].fillna(-1), rows.get(DRIVE, rows["profile"])
    index = ["profile", DRIVE, *[START] * (START in rows)]
    return rows.assign(**{"training_seed": seeds, DRIVE: drives}).pivot_table(
        index=index, columns="training_seed", values=of, aggfunc="sum", observed=True
    )


def crossed_rewards(runs: pd.DataFrame) -> intervals.Estimate:
    """Return the mean of :func:`reward_per_seed` with its interval over drives and seeds."""
    return intervals.crossed(runs, drives=_drives(runs))


def _drives(runs: pd.DataFrame) -> list[object] | None:
    return drives_of(runs.index.to_frame())


def win_rates(
    episodes: pd.DataFrame,
    of: str = "hcfs",
    against: Sequence[str] | None = None,
    case: str = WINDOW_CASES,
) -> pd.DataFrame:
    """Compare the strategy ``of`` with others, all by default, on the same windows.

    Returns:
        One row per other strategy: share of windows [%] with a larger reward of ``of`` (ties count
        half), mean difference of Σ reward, and this difference as a share of the other's cost [%],
        with 95 % intervals over drives and seeds. Trained strategies are compared by seed;
        ``seeds_ahead`` counts the seeds with a positive difference.
    """
    reward = reward_per_seed(episodes, of, case)
    names = [n for n in dict.fromkeys(episodes["strategy"]) if n != of]
    rows = []
    for name in names if against is None else against:
        other = reward_per_seed(episodes, name, case)
        if len(other.columns) == 1:
            other = pd.concat([other.iloc[:, 0]] * len(reward.columns), axis=1, keys=reward.columns)
        shared = reward.columns.intersection(other.columns)
        difference = reward[shared] - other[shared]
        wins = (difference > 1e-6) + 0.5 * (difference.abs() <= 1e-6)
        row: dict[str, object] = {"strategy": of, "against": name}
        row |= {"trainings": len(shared), "windows": len(difference)}
        row |= crossed_rewards(wins).columns("wins_pct", 100.0)
        row |= crossed_rewards(difference).columns("reward_gain")
        # Rewards are negative: the share of the cost that is saved.
        both = -reward[shared], -other[shared]
        gain = intervals.saving(*both, paired=True, drives=_drives(reward))
        row |= gain.columns("gain_pct", 100.0)
        rows.append(row | {"seeds_ahead": int((difference.mean() > 0).sum())})
    return pd.DataFrame(rows)


def windows(episodes: pd.DataFrame, strategies: Sequence[str], of: str = "hcfs") -> pd.DataFrame:
    """Return errors, jerk and reward of strategies on held-out windows, and gains of ``of``.

    Intervals are over windows and, for trained strategies, seeds.
    """
    table = case_table(episodes, WINDOW_CASES).set_index("strategy").loc[list(strategies)]
    against = win_rates(episodes, of, [s for s in strategies if s != of]).set_index("against")
    rows = [
        {
            "strategy": in_words(name),
            "sum of speed errors_mps": table.at[name, "speed_error_sum_mps"],
            "sum of jerks_mps3": table.at[name, "jerk_sum_mps3"],
            **crossed_rewards(reward_per_seed(episodes, name, WINDOW_CASES)).columns("Σ reward"),
        }
        for name in strategies
    ]
    gained = against.reindex(list(strategies))[list(GAINED)].rename(columns=GAINED)
    return pd.concat([pd.DataFrame(rows), gained.reset_index(drop=True)], axis=1)


def whole_gains(episodes: pd.DataFrame, parents: Sequence[str]) -> pd.DataFrame:
    """Return gains of HCFS over its parents on whole records, with intervals over seeds."""
    return pd.DataFrame(
        [
            {"record": record, "against": in_words(str(row["against"]))}
            | {new: row[old] for old, new in GAINED.items() if old.startswith("gain")}
            | {"seeds ahead": row["seeds_ahead"]}
            for case, record in _records(episodes).items()
            for row in win_rates(episodes, against=parents, case=case).to_dict("records")
        ]
    )


def _records(episodes: pd.DataFrame) -> dict[str, str]:
    """Return the cases with whole records, and the names of the records."""
    cases = (c for c in map(str, dict.fromkeys(episodes["case"])) if c.startswith(WHOLE_RECORD))
    return {case: case.removeprefix(WHOLE_RECORD).strip().upper() for case in cases}


def over_cases(episodes: pd.DataFrame, cases: Sequence[str], like: Sequence[str]) -> pd.DataFrame:
    """Return Σ reward by strategy and case, with intervals over seeds, and the paper's values."""
    tables = {case: case_table(episodes, case).set_index("strategy") for case in cases}
    rows = []
    for name in like:
        row: dict[str, object] = {"strategy": in_words(name)}
        for case, table in tables.items():
            row |= {f"{case}{end}": table.at[name, f"reward{end}"] for end in intervals.BOUNDED}
        rows.append(row)
    for name, (*_, reward) in TABLE_IV.items():
        rows.append({"strategy": f"{name}, paper", "case 1": reward, "case 3": CASE_3[name]})
    return pd.DataFrame(rows)


def lengths(rewards_by_length: pd.DataFrame) -> pd.DataFrame:
    """Return Σ reward per window of DDPG and HCFS by the length of DDPG's training.

    Args:
        rewards_by_length: rows of the windows of several studies, with ``training_episodes``.
    """
    rows = []
    for episodes, group in rewards_by_length.groupby("training_episodes"):
        (parent,) = win_rates(group, against=[LEARNED]).to_dict("records")
        rows.append(
            {
                "episodes of training": episodes,
                "trainings": parent["trainings"],
                **crossed_rewards(reward_per_seed(group, LEARNED, WINDOW_CASES)).columns("DDPG"),
                **crossed_rewards(reward_per_seed(group, "hcfs", WINDOW_CASES)).columns("HCFS"),
                **{new: parent[old] for old, new in GAINED.items() if old.startswith("gain")},
            }
        )
    return pd.DataFrame(rows)


def sources(runs: pd.DataFrame, strategies: Sequence[str] = STABLE) -> pd.DataFrame:
    """Return reward, stability and energy behind several sources of leaders.

    Args:
        runs: rows of strategies, seeds and windows, with the ``source`` of the leaders.
        strategies: strategies of the table; the first is the baseline of energy.

    Returns:
        A row per source and strategy: Σ reward and the energy saved against CACC, with intervals
        over windows and seeds; the largest gap error, the worst error ratio and the number of
        runs with an error ratio above 1.
    """
    rows = []
    named = runs["source"].map(LEADERS).fillna(runs["source"])
    for source, group in runs.groupby(named, sort=False):
        spent = {
            name: reward_per_seed(group, name, WINDOW_CASES, "drawn_energy_kj_per_km")
            for name in strategies
            if name in set(group["strategy"])
        }
        for name, energy in spent.items():
            driven = group[group["strategy"] == name]
            saved = intervals.saving(energy, spent[strategies[0]], drives=_drives(energy))
            above = f"{(driven['energy_ratio'] > 1.0).sum()} of {len(driven)}"
            row: dict[str, object] = {"leaders": source, "strategy": in_words(name)}
            row |= crossed_rewards(reward_per_seed(group, name, WINDOW_CASES)).columns("Σ reward")
            row |= {"gap error_m": driven["max_gap_error_m"].max()}
            row |= {"error ratio, above 1": f"{driven['energy_ratio'].max():.2f}, {above}"}
            rows.append(row | saved.columns("drawn energy saved_pct", 100.0))
    return pd.DataFrame(rows)


def whole_records(episodes: pd.DataFrame, strategies: Sequence[str]) -> pd.DataFrame:
    """Return reward, with its range over seeds, and safety on whole records."""
    rows = []
    for case, record in _records(episodes).items():
        for name in strategies:
            runs = episodes[(episodes["case"] == case) & (episodes["strategy"] == name)]
            many = len(runs) > 1
            if len(runs):
                rows.append(
                    {
                        "record": record,
                        "strategy": in_words(name),
                        "Σ reward": runs["reward"].mean(),
                        "Σ reward_low": runs["reward"].min() if many else np.nan,
                        "Σ reward_high": runs["reward"].max() if many else np.nan,
                        "smallest gap_m": runs["min_gap_m"].min(),
                        "runs that collide": f"{(runs['collided'] > 0).sum()} of {len(runs)}",
                        "error ratio": runs["energy_ratio"].max(),
                    }
                )
    return pd.DataFrame(rows)
