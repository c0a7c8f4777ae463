"""tools/energy_models.py prices an evaluation as itself does, and by other models."""

from __future__ import annotations

import energy_models
import numpy as np
import pandas as pd
import pytest
from helpers import check_refused

import lcc_rl
from lcc_rl.energy import CirclesFuel
from lcc_rl.results.intervals import Estimate

WORDS = ["evaluation.profiles=3", "evaluation.drivers=1", "evaluation.sample_episodes=3"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("evaluation")
    words = ["energy=fuel", "leader=udds", "scenario.horizon=60", "evaluation.warm_up=1", *WORDS]
    lcc_rl.compare(["idm_acc"], overrides=words, folder=place)
    return place


def test_its_arguments_are_named() -> None:
    cases = [
        ([], "arguments are required: folder"),
        (["nowhere"], "nowhere: no steps.parquet: evaluate with"),
        (["a", "b", "c"], "unrecognized arguments: c"),
    ]
    check_refused(energy_models.main, cases)


def test_the_same_model_gives_the_energies_of_the_evaluation(folder) -> None:
    driven, profiles, step = energy_models.motions(pd.read_parquet(folder / "steps.parquet"))
    rows = pd.read_parquet(folder / "episodes.parquet").set_index(["strategy", "profile"])
    price = energy_models.own(CirclesFuel())
    for name, speeds in driven.items():
        joules = price(speeds.reshape(-1, speeds.shape[-1]), step).reshape(len(profiles), -1)
        wanted = rows.loc[[(name, one) for one in profiles], "total_net_energy_kj"]
        # The steps lack the state before the first one.
        assert np.abs(joules.sum(1) / 1e3 / wanted.to_numpy() - 1.0).max() < 0.05
    found = energy_models.savings(folder, "human")
    assert {"alcc", "electric", "midBase", "Class8Tractor"} <= set(found)
    assert all(np.isfinite(x["idm_acc"].value) for x in found.values())
    values = [found[name]["idm_acc"].value for name in ("alcc", "midBase", "Class8Tractor")]
    assert len(set(np.round(values, 6))) == 3


@pytest.mark.parametrize("module", ["sumo", "fastsim"])
def test_models_of_others(folder, module) -> None:
    pytest.importorskip(module)
    driven, _, step = energy_models.motions(pd.read_parquet(folder / "steps.parquet"))
    speeds = driven["human"].reshape(-1, driven["human"].shape[-1])
    price = {"sumo": energy_models.by_sumo(energy_models.SUMO_CLASSES[0])}
    joules = price.get(module, energy_models.by_fastsim)(speeds, step)
    ratio = joules.sum() / energy_models.own(CirclesFuel())(speeds, step).sum()
    assert 0.4 < ratio < 2.5


def test_models_that_disagree_are_named() -> None:
    table = {
        "one": {"a": Estimate(0.02), "b": Estimate(0.02), "c": Estimate(-0.01)},
        "two": {"a": Estimate(0.05), "b": Estimate(0.03), "c": Estimate(0.01)},
    }
    assert energy_models.disagreements(table) == [
        "the model decides the saving of a: one +2.0 %, two +5.0 %",
        "the model decides the saving of c: one -1.0 %, two +1.0 %",
    ]


def test_what_cannot_be_priced_is_one_line(folder, tmp_path) -> None:
    cases = [
        (tmp_path, "human", "no steps.parquet: evaluate with evaluation.sample_episodes"),
        (folder, "nobody", "nobody is not in .*: it has acc, human, idm, idm_acc"),
    ]
    check_refused(energy_models.savings, cases)
    steps = pd.read_parquet(folder / "steps.parquet")
    collided = steps.assign(hdv_speed=np.nan)
    cases = [
        (steps.rename(columns={"driver_id": "case"}), "not of a string .* but of a platoon"),
        (collided, "every strategy has an episode with a collision"),
    ]
    check_refused(energy_models.motions, cases)
