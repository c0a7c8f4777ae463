"""Scores of a task and the units they come in."""

import numpy as np
import pandas as pd
import pytest

from lcc_rl.energy import CirclesFuel, ElectricCar, Fleet, PaperMotor, as_fleet
from lcc_rl.errors import ConfigError
from lcc_rl.results.scores import Task, as_rich, scores
from lcc_rl.results.units import per_distance

CAR, LORRY, MOTOR = as_fleet(CirclesFuel()), CirclesFuel(vehicle="Class8Tractor"), as_fleet(None)


def rows(strategy: str, energy: list[float], metres: float = 1000.0, **more: float) -> pd.DataFrame:
    """Rows of as many windows as there are energies [kJ]."""
    count = len(energy)
    table = {
        "strategy": strategy,
        "training_seed": pd.array([pd.NA] * count, dtype="Int64"),
        "profile_id": range(count),
        "driver_id": 0,
        "total_net_energy_kj": energy,
        "cav_distance_m": metres / 2,
        "hdv_distance_m": metres / 2,
        "max_gap_m": 50.0,
        "min_time_gap_s": 1.2,
        "mean_gap_m": 30.0,
        "final_speed_spread_mps": 0.5,
        "collided": False,
    }
    return pd.DataFrame(table | more)


LIMITS = {"max_gap_m": 120.0, "min_time_gap_s": 1.0}
TASK = Task("mine", "net_energy", "kJ/km", "human", LIMITS)


def test_a_score_is_energy_over_distance_and_falling_behind_gains_nothing() -> None:
    table = pd.concat(
        [
            rows("human", [100.0, 300.0]),
            rows("good", [90.0, 270.0]),
            rows("behind", [90.0, 270.0], 900.0),  # a tenth less energy for a tenth less road
        ]
    )
    found = scores(table, TASK, MOTOR).set_index("strategy")
    assert found["score"].tolist() == pytest.approx([200.0, 180.0, 200.0])
    assert found.loc["good", "saving"] == pytest.approx(0.1)
    assert found.loc["behind", "saving"] == pytest.approx(0.0, abs=1e-9)
    assert found.loc["behind", "distance_lost"] == pytest.approx(0.1)
    assert np.isnan(found.loc["human", "saving"])
    assert found.loc["good", "saving_low"] <= 0.1 <= found.loc["good", "saving_high"] + 1e-12


@pytest.mark.parametrize(
    ("change", "kept"),
    [
        ({}, True),
        ({"max_gap_m": 121.0}, False),
        ({"min_time_gap_s": 0.9}, False),
        ({"collided": True}, False),
    ],
)
def test_limits_are_kept_by_the_worst_episode(change, kept) -> None:
    wrong = rows("own", [1.0, 1.0])
    for column, value in change.items():
        wrong.loc[1, column] = value
    found = scores(pd.concat([rows("human", [1.0, 1.0]), wrong]), TASK, MOTOR)
    assert found["kept"].tolist() == [True, kept]


def test_a_share_is_limited_in_the_mean() -> None:
    table = pd.concat([rows("human", [1.0, 1.0]), rows("own", [1.0, 1.0])])
    table["share_ttc_unsafe"] = [0.0, 0.0, 0.0, 0.03]
    for bound, kept in ((0.02, True), (0.01, False)):
        task = Task("mine", limits={"share_ttc_unsafe": bound})
        assert scores(table, task, MOTOR)["kept"].tolist() == [True, kept]


def test_a_column_may_be_the_score_and_the_table_shows_it() -> None:
    table = pd.concat([rows("human", [1.0]), rows("own", [1.0], final_speed_spread_mps=0.1)])
    task = Task("ring", "final_speed_spread_mps")
    found = scores(table, task, MOTOR)
    assert found["score"].tolist() == pytest.approx([0.5, 0.1])
    assert found["saving"].iloc[1] == pytest.approx(0.8)
    drawn = as_rich(found, task, "ring")
    assert [str(column.header) for column in drawn.columns] == ["", "human", "own"]


def test_a_training_that_meets_nobody_is_compared_with_itself() -> None:
    table = rows("own", [1.0, 2.0])
    task = TASK.among(table["strategy"])
    assert task.against == "own"
    assert scores(table, task, MOTOR)["saving"].isna().all()
    assert TASK.among(["own", "human"]) is TASK


def test_units() -> None:
    fuel = CirclesFuel()
    kj = 45.0 * fuel.heating_value / 1e3  # 45 g/km
    assert per_distance(kj, "g/km", CAR) == pytest.approx(45.0)
    assert per_distance(kj, "L/100km", CAR) == pytest.approx(4.5 / 0.745)
    assert per_distance(kj, "mpg", CAR) == pytest.approx(235.215 * 0.745 / 4.5)
    assert per_distance(360.0, "Wh/km", as_fleet(ElectricCar())) == pytest.approx(100.0)
    assert per_distance(7.0, "kJ/km", as_fleet(PaperMotor())) == 7.0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda: per_distance(1.0, "g/km", MOTOR),
            "task.unit=g/km needs vehicles that all burn one fuel",
        ),
        (lambda: per_distance(1.0, "mpg", Fleet({"a": CirclesFuel(), "b": LORRY})), "one fuel"),
        (lambda: per_distance(1.0, "miles", CAR), "task.unit.*'miles'.*Wh/km"),
        (lambda: Task("x", "fuel"), "task.score.*'fuel'.*net_energy"),
        (lambda: Task("x", limits={"gap": 1.0}), "task.limits.*'gap'; valid: max_gap_m, "),
        (lambda: Task("x", limits={"max_gap": 1.0}), "'max_gap'.*Did you mean 'max_gap_m'"),
        (lambda: Task("x", limits={"max_gap_m": float("nan")}), "task.limits.max_gap_m"),
        (lambda: scores(rows("own", [1.0]), TASK, MOTOR), "task.against=human"),
        (
            lambda: scores(rows("human", [1.0]), Task("x", limits={"min_ttc_s": 1.0}), MOTOR),
            "task.limits.min_ttc_s: episodes.parquet has no such column",
        ),
    ],
)
def test_mistakes_are_named(make, words) -> None:
    with pytest.raises(ConfigError, match=words):
        make()
