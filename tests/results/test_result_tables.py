"""Summaries, cases of a platoon and scores of a task, by hand."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from rich.table import Table
from scipy import stats

from lcc_rl.energy import as_fleet
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.cases import measured_series
from lcc_rl.results.platoons import case_table
from lcc_rl.results.render import as_csv, as_latex, as_markdown, print_table, saved_text, terminal
from lcc_rl.results.report import report, summary, windows_for
from lcc_rl.results.task import Task
from lcc_rl.studies.hcfs.tables import win_rates

CARS = {"direct": [np.nan] * 2, "idm": [100.0, 100.0], "reference": [90.0, 100.0]}
CARS["alcc"] = [95.0, 80.0]  # energy of the controlled car by driver [kJ]


def episodes() -> pd.DataFrame:
    own = pd.Series(np.concatenate(list(CARS.values())))
    energies = {"cav": own, "hdv": 50.0, "total": own + 50.0}
    table: dict[str, object] = {
        "strategy": np.repeat(list(CARS), 2),
        "profile_id": 0,
        "driver_id": [0, 1] * 4,
        **{f"{name}_energy_kj": energy for name, energy in energies.items()},
        **{f"{name}_net_energy_kj": energy - 10.0 for name, energy in energies.items()},
        "total_path_energy_kj": own + 40.0,
        "cav_distance_m": own.where(own.isna(), 500.0),
        "hdv_distance_m": 500.0,
        "collided": False,
        "min_ttc_s": [5.0, 6.0] * 4,
        "share_ttc_unsafe": [0.0, 0.1] * 4,
        "share_time_gap_long": 0.0,
        "rms_jerk_mps3": 1.0,
    }
    return pd.DataFrame(table)


def test_summary_by_hand() -> None:
    table = summary(windows_for(episodes())).set_index("strategy")
    alcc = table.loc["alcc"]
    assert alcc["total_energy_kj"] == pytest.approx(137.5)  # (145 + 130)/2
    assert alcc["against"] == "idm"
    assert alcc["drawn_saving"] == pytest.approx(1 - 137.5 / 150)
    assert alcc["saving"] == pytest.approx(1 - 127.5 / 140)
    assert np.isnan(alcc["saving_low"])  # one window, no seeds: nothing varies
    assert (alcc["min_ttc_s"], alcc["share_ttc_unsafe"]) == (5.0, pytest.approx(0.05))
    # 275 kJ over two episodes of two vehicles and 0.5 km each: 2 km.
    assert alcc["kj_per_km"] == pytest.approx(137.5)
    assert table.loc["direct", "kj_per_km"] == pytest.approx(100.0)
    assert np.isnan(table.loc["idm", "drawn_saving"])
    unmeasured = episodes()  # a collision in the warm-up leaves no measures
    unmeasured.loc[7, [x for x in unmeasured if x.endswith(("_kj", "_m"))]] = np.nan
    table = summary(windows_for(unmeasured)).set_index("strategy")
    assert table.loc["alcc", "kj_per_km"] == pytest.approx(145.0)


def test_of_two_windows_each_is_left_out() -> None:
    first = episodes()
    second = first.assign(profile_id=1)
    second.loc[second.index[-1], "total_path_energy_kj"] += 30.0
    row = summary(windows_for(pd.concat([first, second]))).set_index("strategy").loc["alcc"]
    low, high = (row[f"saving_{end}"] for end in ("low", "high"))
    # 142.5 or 127.5 kJ against 140 are left, with one degree of freedom.
    half = stats.t.ppf(0.975, 1) * 7.5 / 140
    assert (low, high) == pytest.approx((1 - 135 / 140 - half, 1 - 135 / 140 + half))


def test_a_saving_per_km_is_of_the_sums_over_windows() -> None:
    rows = pd.DataFrame(
        {
            "strategy": ["idm"] * 2 + ["alcc"] * 2,
            "training_seed": pd.array([None] * 2 + [0] * 2, dtype="Int64"),
            "profile_id": [0, 1] * 2,
            "driver_id": 0,
            "total_path_energy_kj": [1.0, 10.0, 2.0, 8.0],
            "cav_distance_m": [1.0, 10.0] * 2,
            "collided": False,
        }
    )
    row = summary(windows_for(rows)).set_index("strategy").loc["alcc"]
    assert row["saving"] == pytest.approx(1.0 / 11.0)


def test_saving_and_flow_are_of_the_same_seeds() -> None:
    flows = {("reference", 0): 1000.0, ("alcc", 0): 950.0, ("alcc", 1): 500.0}
    rows = pd.DataFrame(
        {"strategy": name, "training_seed": seed, "profile_id": profile, "flow_vph": flow * factor}
        for (name, seed), flow in flows.items()
        for profile, factor in enumerate((1.0, 1.1, 0.9))
    ).assign(driver_id=0, total_path_energy_kj=1.0, cav_distance_m=1.0, collided=False)
    row = summary(windows_for(rows), against="reference").set_index("strategy").loc["alcc"]
    lost = [row[f"flow_lost{end}"] for end in ("_low", "", "_high")]
    assert lost == pytest.approx([0.05] * 3)  # of seed 0, as the saving


def series() -> dict[str, torch.Tensor]:
    """Two followers, one run, three frames."""
    error = [[1.0, 0.5], [-1.0, 0.5], [2.0, -0.5]]
    found = {
        "leader_speed_error": error,
        "gap_error": [[0.0, -1.0], [-2.0, 0.5], [-1.0, -5.1]],
        "speed_error": [[1.0, 2.0], [1.0, 0.0], [0.0, 0.0]],
        "jerk": [[4.0, 0.0], [-6.0, 1.0], [0.0, 0.0]],
        "reward": (-torch.tensor(error).abs()).tolist(),
        "gap": [[5.0, 4.0], [3.0, 4.0], [4.0, -0.1]],
        "power": [[100.0, 0.0], [200.0, -20.0], [300.0, 50.0]],
        "winner": [[0, 1], [1, 1], [1, 1]],
        "switches": [[0, 0], [1, 0], [1, 0]],
        "clamps": [[0, 0]] * 3,
        "cap_interventions": [[0, 0]] * 3,
    }
    speed = torch.tensor([[10.0, 8.0], [12.0, 8.0], [10.0, 7.0], [10.0, 7.0]]).view(4, 1, 2)
    rows = {name: torch.tensor(values).view(3, 1, 2) for name, values in found.items()}
    return {**rows, "speed": speed}


def test_measures_of_a_platoon_by_hand() -> None:
    first, second = measured_series(series()).to_dict("records")
    assert (first["speed_error_sum"], second["speed_error_sum"]) == (4.0, 1.5)
    assert (first["jerk_sum"], first["peak_jerk_mps3"]) == (10.0, 6.0)
    assert (first["min_gap_m"], first["collided"], second["collided"]) == (3.0, False, True)
    assert (first["max_gap_error_m"], second["max_gap_error_m"]) == (2.0, pytest.approx(5.1))
    assert pd.isna(first["energy_ratio"])
    assert second["energy_ratio"] == pytest.approx(4.0 / 2.0)
    # J and m of a step's length: 600 / (11 + 11 + 10), 30 / (8 + 7.5 + 7).
    assert first["drawn_energy_kj_per_km"] == pytest.approx(600 / 32)
    assert second["drawn_energy_kj_per_km"] == pytest.approx(30 / 22.5)
    assert first["learned_share"] == pytest.approx(2 / 3)
    assert (first["switches"], second["switches"], first["frames"]) == (1, 0, 3)


def test_case_table_by_hand() -> None:
    rows = measured_series(series()).assign(
        strategy="hcfs", training_seed=pd.Series([0, 0], dtype="Int64"), case="case 1", profile="a"
    )
    (row,) = case_table(rows, "case 1").to_dict("records")
    errors = pd.Series([1.0, 1.0, 2.0, 0.5, 0.5, 0.5])
    assert row["speed_error_sum_mps"] == pytest.approx(5.5)
    assert row["speed_error_std_mps"] == pytest.approx(errors.std(ddof=0))
    assert row["reward"] == pytest.approx(-5.5)
    assert (row["collisions"], row["switches"]) == (1, 1)
    assert (row["max_gap_error_m"], row["error_ratio"]) == (pytest.approx(5.1), pytest.approx(2.0))
    assert row["learned_share"] == pytest.approx(5 / 6)
    with pytest.raises(ConfigError, match="case 9"):
        case_table(rows, "case 9")
    mixed = series()  # the second follower is a human driver, who earns nothing
    mixed["reward"][..., 1] = torch.nan
    rows = measured_series(mixed).assign(strategy="x", training_seed=pd.NA, case="a", profile="a")
    (row,) = case_table(rows, "a").to_dict("records")
    assert (row["speed_error_sum_mps"], row["jerk_sum_mps3"], row["reward"]) == (4.0, 10.0, -4.0)
    assert row["speed_error_std_mps"] == pytest.approx(errors[:3].std(ddof=0))


def rewards(strategy: str, seed: int | None, *values: float) -> pd.DataFrame:
    table = {"strategy": strategy, "training_seed": pd.Series([seed] * len(values), dtype="Int64")}
    table |= {"case": "windows", "profile": [f"w{i}" for i in range(len(values))], "reward": values}
    return pd.DataFrame(table)


def test_win_rates_by_hand() -> None:
    found = [
        rewards("cacc", None, -2.0, -2.0, -2.0, -2.0),
        rewards("ddpg", 0, -1.0, -3.0, -1.0, -1.0),
        rewards("ddpg", 1, -4.0, -4.0, -4.0, -4.0),
        rewards("hcfs", 0, -1.0, -1.0, -3.0, -2.0),
        rewards("hcfs", 1, -1.0, -1.0, -1.0, -1.0),
    ]
    table = win_rates(pd.concat(found, ignore_index=True)).set_index("against")
    # Against cacc: seed 0 wins 2, loses 1, ties 1 → 62.5 %; seed 1 wins all.
    assert table.loc["cacc", "wins_pct"] == pytest.approx((62.5 + 100.0) / 2)
    assert table.loc["cacc", "reward_gain"] == pytest.approx((0.25 + 1.0) / 2)
    # Against its own parent, seed by seed: 1 win, 2 losses, 1 tie; then 4 wins.
    assert table.loc["ddpg", "wins_pct"] == pytest.approx((37.5 + 100.0) / 2)
    assert table.loc["ddpg", "windows"] == 4


MOTOR = as_fleet(None)
TASK = Task(name="mine", limits={"max_gap_m": 120.0, "min_time_gap_s": 1.0})


def driven(strategy: str, *energy: float, metres: float = 1000.0, **more: float) -> pd.DataFrame:
    """Rows of as many windows as there are energies [kJ]."""
    table = {"strategy": strategy, "profile_id": range(len(energy)), "driver_id": 0}
    table |= {"training_seed": pd.array([pd.NA] * len(energy), dtype="Int64")}
    table |= {"cav_distance_m": metres / 2, "hdv_distance_m": metres / 2, "collided": False}
    table |= {"max_gap_m": 50.0, "min_time_gap_s": 1.2, "final_speed_spread_mps": 0.5}
    return pd.DataFrame(table | {"total_net_energy_kj": energy} | more)


def test_a_score_is_energy_over_distance_and_falling_behind_gains_nothing() -> None:
    rows = [driven("human", 100.0, 300.0), driven("good", 90.0, 270.0)]
    rows.append(driven("behind", 90.0, 270.0, metres=900.0))  # a tenth less energy, and road
    found = summary(windows_for(pd.concat(rows)), TASK, MOTOR).set_index("strategy")
    assert found["score"].tolist() == pytest.approx([200.0, 180.0, 200.0])
    assert found.loc["good", "saving"] == pytest.approx(0.1)
    assert found.loc["behind", "saving"] == pytest.approx(0.0, abs=1e-9)
    assert found.loc["behind", "distance_lost"] == pytest.approx(0.1)
    assert np.isnan(found.loc["human", "saving"])
    assert TASK.among(["own"]).against == "own"


def test_all_scores_of_a_ring_name_the_damped_episodes_and_their_mean_time(capsys) -> None:
    never = driven("human", 1.0, 1.0).assign(damping_time_s=np.nan)
    own = driven("own", 1.0, 1.0, 1.0).assign(damping_time_s=[30.0, 40.0, np.nan])
    print_table(terminal(report(windows_for(pd.concat([never, own])), TASK, MOTOR), full=True))
    lines = capsys.readouterr().out.splitlines()
    rows = [line.split()[-2:] for line in lines if "calm" in line or "from when on" in line]
    assert rows == [["0%", "67%"], ["–", "35"]]


def test_a_table_in_a_pipe_is_as_wide_as_its_content_or_as_columns(monkeypatch, capsys) -> None:
    table, widths = Table(*(f"measure {number}" for number in range(12))), {}
    for columns in ("", "80"):
        monkeypatch.setenv("COLUMNS", columns) if columns else monkeypatch.delenv("COLUMNS", False)
        print_table(table)
        widths[columns] = max(map(len, capsys.readouterr().out.splitlines()))
    assert widths["80"] == 80 < widths[""]


def test_a_table_marks_strategies_that_lose_more_than_2_percent_of_the_flow() -> None:
    flows = {"human": 2000.0, "idm_acc": 1920.0, "pi_saturation": 1600.0}
    rows = pd.concat(driven(name, 1.0, flow_vph=flow) for name, flow in flows.items())
    one = report(windows_for(rows), TASK, MOTOR)
    found = one.table
    assert found["flow_pct"].tolist() == pytest.approx([0.0, -4.0, -20.0])
    lost = "†: flow lost against simulated drivers: tuned IDM 4 %; PI with saturation 20 %."
    assert lost in one.remarks
    crowd = driven("direct", 1.0, flow_vph=1800.0)  # no path energy of automated cars: no row
    rows = pd.concat([rows.assign(total_path_energy_kj=1.0), crowd])
    assert [lost] == report(windows_for(rows), energy=MOTOR).remarks
    assert report(windows_for(rows), energy=MOTOR, against="rule").against == "idm_acc"
    marked = ["simulated drivers", "tuned IDM †", "PI with saturation †"]
    assert one.short["driver"].tolist() == marked
    assert found["kept"].all()


def test_flow_may_be_limited_to_that_of_other_strategies(capsys) -> None:
    flows = {"human": 2000.0, "recorded": 1900.0, "near": 1950.0, "far": 1800.0}
    rows = pd.concat(driven(name, 1.0, flow_vph=flow) for name, flow in flows.items())
    task = Task(name="mine", limits={"flow_vph": "recorded"})
    one = report(windows_for(rows), task, MOTOR)
    assert one.table["kept"].tolist() == [True, True, True, False]
    print_table(terminal(one))
    assert " ≥ 1,900 " in capsys.readouterr().out
    # Of the simulated drivers, which the task compares with, that is 1,940.
    share = replace(task, limits={"flow_vph": "97 %"})
    kept = report(windows_for(rows), share, MOTOR).table["kept"]
    assert kept.tolist() == [True, False, True, False]
    alone = report(windows_for(rows[rows["strategy"] == "far"]), task, MOTOR)
    assert alone.table["kept"].tolist() == [True]  # nobody is there to keep it to


def test_all_scores_name_limits_in_words_and_wrap_names_at_spaces_only(capsys) -> None:
    others = ("follower_stopper", "pi_saturation", "constant", "mpc_far")
    rows = pd.concat(driven(name, 1.0, share_ttc_unsafe=0.001) for name in ("human", *others))
    task = Task(name="mine", limits={**TASK.limits, "share_ttc_unsafe": 0.0005})
    print_table(terminal(report(windows_for(rows), task, MOTOR), full=True))
    printed = capsys.readouterr().out
    words = printed.split()
    assert {"FollowerStopper", "saturation", "simulated"} <= set(words)
    assert max(map(len, printed.splitlines())) <= 80
    lines = [line.split() for line in printed.splitlines() if "limit:" in line]
    assert lines[0][:5] == ["limit:", "gap", "≤", "120", "m"]
    assert lines[2][:9] == ["limit:", "TTC", "<", "4", "s", "≤", "0.05", "%", "0.10%"]


def test_limits_are_kept_by_the_worst_episode() -> None:
    worse = ("max_gap_m", 121.0), ("min_time_gap_s", 0.9), ("collided", True)
    for column, value in (("max_gap_m", 50.0), *worse):
        own = driven("own", 1.0, 1.0)
        own.loc[1, column] = value
        found = summary(windows_for(pd.concat([driven("human", 1.0, 1.0), own])), TASK, MOTOR)
        assert found["kept"].tolist() == [True, value == 50.0], column


def test_a_share_is_limited_in_the_mean_and_a_column_may_be_the_score() -> None:
    own = driven("own", 1.0, 1.0, final_speed_spread_mps=0.1)
    rows = pd.concat([driven("human", 1.0, 1.0), own]).assign(share_ttc_unsafe=[0, 0, 0, 0.03])
    for bound, kept in ((0.02, True), (0.01, False)):
        task = Task(name="mine", score="final_speed_spread_mps", limits={"share_ttc_unsafe": bound})
        found = summary(windows_for(rows), task, MOTOR)
        assert found["kept"].tolist() == [True, kept]
        assert found["score"].tolist() == pytest.approx([0.5, 0.1])


def test_no_share_is_given_of_a_spread_without_a_wave() -> None:
    """The first seconds of a ring: 0.02 m/s of human drivers would be a saving of −900 %."""
    task = Task(name="mine", score="final_speed_spread_mps")
    words = "no saving: the baseline, simulated drivers, is below 0.5 m/s; "
    for spread, saved in ((0.02, np.nan), (0.49, np.nan), (0.5, 0.6), (2.0, 0.9)):
        human = driven("human", 1.0, 1.0, final_speed_spread_mps=spread)
        own = driven("own", 1.0, 1.0, final_speed_spread_mps=0.2)
        one = report(windows_for(pd.concat([human, own])), task, MOTOR)
        assert one.table["saving"].tolist()[1] == pytest.approx(saved, nan_ok=True), spread
        assert one.caption.startswith(words) == np.isnan(saved), spread


def test_signs_of_a_name_stay_in_its_cell() -> None:
    table = pd.DataFrame({"driven by": ["a|b_c & 5 %\n#"], "energy_kj": [1.0]})
    head, rule, row = as_markdown(table).splitlines()
    assert [len(re.split(r"(?<!\\)\|", line)) for line in (head, rule, row)] == [4, 4, 4]
    assert r"a\|b_c & 5 % #" in row
    assert r"a|b\_c \& 5 \%" in as_latex(table)
    printed = as_latex(pd.DataFrame({"TTC < 4 s, Σ m²/s³": ["≤ −1 ± 2"]}))
    assert "TTC $<$ 4 s" in printed  # a bare one is another sign in the default encoding
    assert printed.isascii()


def test_zeros_have_no_sign_but_as_bounds() -> None:
    table = pd.DataFrame({"saved_pct": [-0.0, -1e-9], "n": [0, 1]})
    zero = saved_text(-0.04, -1e-12, 0.0)
    for text in (as_markdown(table), as_latex(table), as_csv(table[:1]), zero):
        assert not re.search(r"[-−]\$?0\.?0*\b", text), text
    small = pd.DataFrame({"flow_pct": [0.0, 0.033], "flow\n[%]": [0.0, 0.033]})
    assert as_markdown(small).endswith("| 0.03 | 0.03 |")
    assert saved_text(-0.04, -0.06, 0.0) == "0.0 (−0.1 … 0.0)"
    assert saved_text(0.2, -0.04, 0.3) == "+0.2 (−0.0 … 0.3)"  # within the uncertainty
    shares = report(windows_for(episodes().assign(share_ttc_unsafe=1.0 / 3.0))).short
    assert shares["unsafe_ttc_pct"].iloc[0] == pytest.approx(100.0 / 3.0, rel=1e-12)
    assert as_csv(pd.DataFrame({"x": [-0.0, 1.5]}), "comma").split() == ["x", "0,0", "1,5"]
