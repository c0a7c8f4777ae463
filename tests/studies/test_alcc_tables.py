"""The ALCC study's tables against numbers worked out by hand."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from study_frames import episodes, training, windows

from lcc_rl.results.windows import Means
from lcc_rl.studies.alcc import paper_tables
from lcc_rl.studies.alcc import tables as alcc_tables

# Mean energy of the human driver: + 2 kJ per driver number, + 5 kJ for the second of two profiles.
SHIFT = 2.0 + 5.0
ENERGY, SPEED = "leader path energy [kJ]", "leader speed [m/s]"


def test_headline_by_hand() -> None:
    table = alcc_tables.headline_rows(windows()).set_index(["strategy", "against"])
    idm = 100.0 + 50.0 + SHIFT
    reference = 85.0 + 50.0 + SHIFT
    alcc = 86.0 + 40.0 + SHIFT + 20.0 / 3
    row = table.loc[("alcc", "idm")]
    assert row["saving_pct"] == pytest.approx(100 * (1 - alcc / idm))
    # One window of two and one seed of two are left out, each with a degree of freedom.
    pairs = [[(alcc + x, idm + x) for x in (-5, 5)], [(alcc + x, idm) for x in (-2, 2)]]
    parts = [np.var([100 * (1 - own / other) for own, other in pair]) for pair in pairs]
    half = stats.t.ppf(0.975, sum(parts) ** 2 / np.square(parts).sum()) * sum(parts) ** 0.5
    assert row["saving_pct_high"] - row["saving_pct"] == pytest.approx(half)
    assert row["saving_pct"] - row["saving_pct_low"] == pytest.approx(half)
    assert row["worst_seed_saving_pct"] == pytest.approx(100 * (1 - (alcc + 2) / idm))
    assert row["path_saving_pct"] == pytest.approx(100 * (1 - (alcc - 20) / (idm - 20)))
    # Driver 0 of 3 draws 150 − 146 less than with idm: nobody is worse off; with the reference 11
    # more, in both windows.
    row = table.loc[("alcc", "reference")]
    assert row["saving_pct"] == pytest.approx(100 * (1 - alcc / reference))
    assert row["saving_pct_low"] < row["saving_pct"] < row["saving_pct_high"]
    assert set(table.index) == {("alcc", "idm"), ("alcc", "reference"), ("reference", "idm")}


def test_savings_in_thirds_of_the_windows() -> None:
    frame = episodes(profiles=6)
    # alcc draws 30 kJ less where the leader draws most, that is, where it is slowest.
    busy = (frame["strategy"] == "alcc") & (frame["profile_id"] >= 4)
    frame.loc[busy, "total_path_energy_kj"] -= 30.0
    table = alcc_tables.strata(Means.of(frame).windows)
    assert set(table["against"]) == {"idm", "reference"}
    rows = table[table["against"] == "idm"].set_index(["by", "tercile"])
    assert rows["windows"].tolist() == [2] * 6
    high, slow = rows.loc[(ENERGY, "upper")], rows.loc[SPEED, "lower"]
    assert (high["least"], high["most"], slow["least"]) == (70.0, 80.0, 4.0)
    assert high["saving_pct"] == pytest.approx(slow["saving_pct"])
    # Windows 4 and 5: the follower behind idm draws 50 + 2 + 45 kJ; idm 100 and the paths 20 less.
    human = 40.0 + 2.0 + 45.0 + 20.0 / 3
    assert high["saving_pct"] == pytest.approx(100 * (1 - (86.0 + human - 50.0) / (197.0 - 20.0)))
    assert (rows["saving_pct_low"] <= rows["saving_pct"]).all()
    assert high["saving_pct"] > rows.loc[ENERGY]["saving_pct"].min()


def test_constraints_name_the_worst_seed() -> None:
    table = alcc_tables.constraints(windows()).set_index("strategy")
    assert table.loc["alcc", "mean_unsafe_ttc_pct"] == pytest.approx(0.1)
    assert table.loc["alcc", "worst_seed_unsafe_ttc_pct"] == pytest.approx(0.2)
    assert table.loc["alcc", "mean_long_time_gap_pct"] == pytest.approx(0.5)
    # The mean is within the limit of 0.1 %, the worst seed is not.
    assert not table.loc["alcc", "within_limits"]
    assert table.loc["reference", "within_limits"]
    by_seed = alcc_tables.constraints_by_seed(windows())
    assert by_seed[["strategy", "seed"]].to_numpy().tolist() == [
        ["alcc", "0"],
        ["alcc", "1"],
        ["reference", "0"],
        ["reference", "1"],
    ]


def test_table_iv_finds_the_best_and_the_worst_driver() -> None:
    table = paper_tables.table_iv(Means.of(episodes()).drivers).set_index(
        ["driver", "strategy", "from"]
    )
    ours = table.xs("this study", level="from")
    # Over both profiles; driver 0 is the one that alcc costs 20 kJ.
    assert ours.loc[("worst", "alcc"), "hdv_energy_kj"] == pytest.approx(40.0 + 5.0 + 20.0)
    assert ours.loc[("worst", "alcc"), "saving_pct"] == pytest.approx(100 * (1 - 151 / 140))
    # Drivers 1 and 2 save the same 9 kJ; driver 1 saves it of less.
    assert ours.loc[("best", "alcc"), "total_energy_kj"] == pytest.approx(86.0 + 47.0)
    assert ours.loc[("best", "alcc"), "saving_pct"] == pytest.approx(100 * (1 - 133 / 142))
    assert ours.loc[("mean", "reference"), "cav_energy_kj"] == pytest.approx(85.0)
    paper = table.xs("paper", level="from")
    assert paper.loc[("mean", "reference"), "total_energy_kj"] == 408.74
    assert paper.loc[("worst", "alcc"), "saving_pct"] == -4.92
    assert paper.loc[("best", "reference"), "hdv_energy_kj"] == 201.91


def test_paper_numbers_agree_with_each_other() -> None:
    for cav, hdv, total in paper_tables.PAPER_TABLE_IV.values():
        assert cav + hdv == pytest.approx(total, abs=0.011)
    for driver, share in paper_tables.PAPER_IMPROVEMENT.items():
        energy = paper_tables.PAPER_TABLE_IV
        reference, alcc = energy[driver, "reference"], energy[driver, "alcc"]
        assert 100 * (1 - alcc[2] / reference[2]) == pytest.approx(share, abs=0.005)
        assert reference[0] == 214.85  # it does not observe who drives behind
    human = paper_tables.PAPER_HUMAN
    assert 100 * (1 - human["scenario_A_kj"] / human["scenario_B_kj"]) == pytest.approx(
        22.1, abs=0.05
    )


def test_holistic_counts_drivers_that_are_worse_off() -> None:
    table = paper_tables.holistic(Means.of(episodes()))
    assert table["drivers_worse_off"].tolist() == ["1 of 3", "1 of 3", "138 of 923"]
    assert table.loc[1, "worst_driver_pct"] == pytest.approx(100 * (1 - 151 / 140))


def test_generalization_has_every_profile_and_the_papers_four() -> None:
    table = paper_tables.generalization(windows())
    assert len(table) == 2
    human = 2.0 + 20.0 / 3
    assert table.loc[1, "saving_pct"] == pytest.approx(
        100 * (1 - (86.0 + 50.0 + human) / (85.0 + 60.0 + 2.0))
    )
    assert table.loc[0, "reference_path_energy_kj"] == pytest.approx(85.0 + 52.0 - 20.0)
    row = paper_tables.generalization_row(windows())
    assert row["profiles"].tolist() == [2, 2, 4]
    assert row.loc[2, "median_pct"] == pytest.approx((7.00 + 8.04) / 2)
    headline = alcc_tables.headline_rows(windows()).set_index(["strategy", "against"])
    assert row.loc[1, "together_pct"] == headline.loc[("alcc", "reference"), "saving_pct"]


def test_human_energy_by_hand() -> None:
    table = paper_tables.human_energy(Means.of(episodes())).set_index(["behind", "energy"])
    row = table.loc[("reference", "as drawn")]
    assert row["scenario_A_kj"] == pytest.approx(57.0)
    assert row["scenario_B_kj"] == pytest.approx(67.0)
    assert row["saving_pct"] == pytest.approx(100 * 10 / 67)
    # The reference's seeds differ in the car's energy only; the windows, in 1/72 and 1/62.
    half = stats.t.ppf(0.975, 1) * 100 * (10 / 62 - 10 / 72) / 2
    assert row["saving_pct_high"] - row["saving_pct"] == pytest.approx(half)
    # alcc costs driver 0: it draws 65 kJ in A and 65 kJ in B.
    assert table.loc[("alcc", "as drawn"), "drivers_better_off"] == "2 of 3"


def test_learning_statistics() -> None:
    frame = training()
    table = alcc_tables.learning(frame)
    assert len(table) == 4
    first = table.iloc[0]
    assert (first["variant"], first["seed"], first["episodes"]) == ("alcc", "0", 400)
    # Tenths of 20 iterations: means of two neighbours.
    assert first["first_tenth"] == pytest.approx(-99.5)
    assert first["last_tenth"] == pytest.approx(-81.5)
    assert first["sd_in_last_tenth"] == pytest.approx(0.5)
    assert first["drop"] == 0.0
    frame.loc[frame["iteration"] > 18, "episode_reward"] -= 10.0
    assert alcc_tables.learning(frame).iloc[0]["drop"] == pytest.approx(8.0)


def test_ablations_are_compared_with_the_humans_of_their_own_scenario() -> None:
    other = episodes()
    other[["cav_energy_kj", "total_energy_kj", "total_path_energy_kj"]] *= 2.0
    frame = pd.concat(
        Means.of(rows).windows.assign(ablation=name)
        for name, rows in (("none", episodes()), ("double", other))
    )
    table = alcc_tables.comparison(frame).set_index(["ablation", "strategy"])
    one, two = (table.loc[(name, "alcc")] for name in ("none", "double"))
    saved = "path_saving_against_idm_pct"
    assert one[saved] == pytest.approx(two[saved])
    assert one[f"{saved}_low"] < one[saved] < one[f"{saved}_high"]
    assert two["total_energy_kj"] == pytest.approx(2 * one["total_energy_kj"])
    assert one["unsafe_ttc_pct"] == pytest.approx(0.1)
    assert (one["rms_jerk_mps3"], one["worst_seed_rms_jerk_mps3"]) == (1.5, 2.0)
    assert one["worst_seed_path_energy_kj"] > one["path_energy_kj"]
    assert np.isnan(table.loc[("none", "reference"), "path_saving_against_reference_pct"])
