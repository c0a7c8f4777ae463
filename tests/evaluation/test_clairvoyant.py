"""Knowing everything must pay, and not at the price of the limits."""

from __future__ import annotations

import pandas as pd
import pytest
import torch
from helpers import POPULATION, compose, wavy_profiles
from tensordict import TensorDict

from lcc_rl.envs import Inputs
from lcc_rl.evaluation.clairvoyant import clairvoyant, misses, path_energy
from lcc_rl.evaluation.episodes import evaluate
from lcc_rl.evaluation.strategies import Strategy, trained
from lcc_rl.functional.pattern import parse_string
from lcc_rl.results.policies import load_policy

STEPS = 60
BOTH = ["total_steady_energy_kj", "total_acceleration_loss_kj"]


INPUTS = Inputs(wavy_profiles(2), wavy_profiles(2), POPULATION)


def learned() -> Strategy:
    cfg = compose("alcc", f"scenario.horizon={STEPS}")
    return trained(cfg, "pretrained", load_policy("pretrained", "alcc"), POPULATION)


def played(strategy: Strategy) -> pd.DataFrame:
    return evaluate(strategy, INPUTS, 2, 10_000, seed=1)[0]


def test_who_knows_the_profile_saves() -> None:
    start, told = learned(), []
    best = clairvoyant(
        start,
        INPUTS,
        drivers=2,
        seed=1,
        iterations=30,
        compiled=False,
        report=lambda iteration, values: told.append((iteration, values["kJ"], values["missed"])),
    )
    before, after = played(start), played(best)
    assert after["strategy"].unique().tolist() == ["clairvoyant"]
    saved = 1.0 - after[BOTH].to_numpy().sum() / before[BOTH].to_numpy().sum()
    assert saved > 0.01
    assert after["share_time_gap_long"].mean() <= before["share_time_gap_long"].mean()
    assert after["share_ttc_unsafe"].mean() <= before["share_ttc_unsafe"].mean()
    # What was minimised is what is measured: the plan was evaluated as it was made.
    assert [number for number, *_ in told] == list(range(1, 31))
    assert told[0][1] == pytest.approx(before[BOTH].sum(axis=1).mean(), rel=1e-4)
    assert told[-1][1] == pytest.approx(after[BOTH].sum(axis=1).mean(), rel=0.01)


def moment(gap: float, relative_speed: float, speed: float) -> TensorDict:
    """One episode of one step, the automated vehicle as given, a driver at rest far behind it."""
    time_gap = gap / max(speed, 1.0)
    own = {"gap": gap, "relative_speed": relative_speed, "time_gap": time_gap, "speed": speed}
    behind = {"gap": 100.0, "relative_speed": 0.0, "time_gap": 100.0, "speed": 0.0}
    entries = {key: torch.tensor([own[key], behind[key]]).view(1, 1, 2, 1) for key in own}
    one = {"vehicles": entries}
    return TensorDict({**one, "next": one}, batch_size=[1, 1])


@pytest.mark.parametrize(
    ("gap", "relative_speed", "speed", "missed"),
    [
        (10.0, 0.0, 5.0, 0.0),
        (10.0, -2.0, 5.0, 0.0),  # 5 s to collision
        (10.0, -3.0, 5.0, (2.12 + 0.3 * 2.12**2)),  # 4.04·3 − 10
        (15.0, 0.0, 5.0, 15.0 - 12.5 / 1.01 + 0.3 * (15.0 - 12.5 / 1.01) ** 2),
        (0.3, 0.0, 5.0, 2.0),  # 10·(0.5 − 0.3)
    ],
)
def test_misses(gap, relative_speed, speed, missed) -> None:
    found = misses(moment(gap, relative_speed, speed), parse_string("automated human"))
    assert float(found) == pytest.approx(missed, abs=1e-4)


@pytest.mark.slow
def test_without_regard_the_car_alone_saves() -> None:
    start = learned()
    plans = [clairvoyant(start, INPUTS, 2, 1, 30, False, own) for own in (True, False)]
    alone, both = (played(plan) for plan in plans)
    assert alone["strategy"].unique().tolist() == ["clairvoyant own"]
    assert alone["cav_path_energy_kj"].mean() < both["cav_path_energy_kj"].mean()
    assert alone["total_path_energy_kj"].mean() > both["total_path_energy_kj"].mean()


def test_path_energy_at_constant_speed() -> None:
    # 0.1 s of A2 at 5 and 0 m/s, without acceleration.
    watts = 110.3 + 422.9 * 5 - 0.0279 * 25 + 0.3557 * 125 + 110.3
    assert float(path_energy(moment(10.0, 0.0, 5.0), 0.1)) == pytest.approx(watts * 1e-4)


@pytest.mark.slow
def test_the_command(tmp_path, capsys) -> None:
    from lcc_rl.commands import clairvoyant as tool

    short = ["scenario.horizon=30", "evaluation.profiles=1", "evaluation.drivers=2"]
    own = ["--iterations", "2", "--no-compile", "--out", str(tmp_path)]
    assert tool.main([*own, *short]) == 0
    assert "clairvoyant" in capsys.readouterr().out
    rows = pd.read_parquet(tmp_path / "episodes.parquet")
    assert rows["strategy"].value_counts().to_dict() == {"idm": 2, "alcc": 2, "clairvoyant": 2}
    starts = ["--policy", "pretrained", "--policy", "pretrained/reference", "--regard"]
    two = ["scenario.horizon=30", "evaluation.profiles=2", "evaluation.drivers=2"]
    assert tool.main([*own, *starts, *two]) == 0
    assert "take" in capsys.readouterr().out
    rows = pd.read_parquet(tmp_path / "episodes.parquet")
    names = ["idm", "alcc", "reference", "clairvoyant", "clairvoyant own"]
    assert rows["strategy"].value_counts().to_dict() == dict.fromkeys(names, 4)
    assert rows.groupby("strategy")["profile_id"].agg(set).map(sorted).tolist() == [[0, 1]] * 5
