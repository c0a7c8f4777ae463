"""Savings at equal flow, of a second energy model, and of strategies that collide or end slower."""

from __future__ import annotations

from itertools import product

import numpy as np
import pandas as pd
import pytest
from helpers import strategies_of

from lcc_rl.commands import evaluation
from lcc_rl.config import load
from lcc_rl.energy import SECOND
from lcc_rl.errors import ConfigError
from lcc_rl.results.fronts import at_equal_flow
from lcc_rl.results.intervals import Estimate
from lcc_rl.results.report import report, summary, windows_for

WINDOWS = 8
NAMES = ("rule", "rule X=1", "rule X=2", "alcc", "alcc X=1", "recorded")
FLOWS = dict(zip(NAMES, (1000.0, 1100.0, 900.0, 940.0, 1060.0, 1040.0), strict=True))
ENERGIES = dict(zip(NAMES, (100.0, 110.0, 96.0, 90.0, 102.0, 120.0), strict=True))


def rows(**changed: dict[str, float]) -> pd.DataFrame:
    """One driver behind 8 leaders, each car 1 km; energies by strategy, and by leader."""
    parts = []
    for name, energy in ENERGIES.items():
        number = np.arange(WINDOWS)
        part = pd.DataFrame(
            {
                "strategy": name,
                "profile_id": number,
                "profile": [f"w{x}" for x in number],
                "drive": [f"d{x}" for x in number],
                "driver_id": 0,
                "total_path_energy_kj": energy * (1.0 + 0.1 * number),
                "total_energy_kj": energy * (1.0 + 0.1 * number),
                f"total_{SECOND}": 2.0 * energy * (1.0 + 0.1 * number),
                "cav_distance_m": 1000.0,
                "hdv_distance_m": 1000.0,
                "flow_vph": FLOWS[name] + number,
                "max_leader_braking_mps2": 6.0,
                "max_braking_mps2": 3.0,
                "collided": False,
            }
        )
        parts.append(part.assign(**{x: y[name] for x, y in changed.items() if name in y}))
    return pd.concat(parts, ignore_index=True)


def test_a_strategy_is_compared_at_the_flow_of_the_recorded_drivers() -> None:
    windows = windows_for(rows())
    table = summary(windows).set_index("strategy")
    assert list(table.index) == ["rule", "alcc", "recorded"]  # not the points of the front
    # At 1,040 vehicles per hour: 90 + 12 · 100/120 = 100 kJ, and 100 + 10 · 40/100 = 104 kJ.
    found = table.loc["alcc"]
    for key, expected in (
        ("saving", 1.0 - 90.0 / 120.0),
        ("second_saving", 1.0 - 90.0 / 120.0),
        ("flow_saving", 1.0 - 100.0 / 120.0),
        ("second_flow_saving", 1.0 - 100.0 / 120.0),
        ("rule_saving", 1.0 - 100.0 / 104.0),
    ):
        assert found[key] == pytest.approx(expected), key
        assert found[f"{key}_low"] - 1e-9 <= found[key] <= found[f"{key}_high"] + 1e-9
    assert found["against"] == "recorded"
    assert table.loc["rule", "flow_saving"] == pytest.approx(1.0 - 104.0 / 120.0)
    assert np.isnan(table.loc["rule", "rule_saving"])
    energy = "total_path_energy_kj"

    def found_for(own: list[str], other: list[str]) -> Estimate:
        return at_equal_flow(windows, own, other, energy, "recorded")

    def saved(own: list[str], other: list[str]) -> float:
        return found_for(own, other).value

    # A front with more flow everywhere counts with its least flow; the rival must reach the flow.
    assert saved(["rule X=1"], ["recorded"]) == pytest.approx(1.0 - 110.0 / 120.0)
    assert np.isnan(saved(["rule X=2"], ["recorded"]))
    assert np.isnan(saved(["alcc", "alcc X=1"], ["rule X=1"]))
    assert np.isnan(saved(["rule", "rule X=1"], ["rule X=2"]))  # a point with less flow
    more = (1100.0 + 3.5) / (1040.0 + 3.5) - 1.0
    assert found_for(["rule X=1"], ["recorded"]).more_flow == pytest.approx(more)
    assert found_for(["alcc", "alcc X=1"], list(NAMES[:3])).more_flow == 0.0


def test_a_table_marks_savings_at_more_flow_than_the_recorded_drivers_have() -> None:
    faster = {"alcc": 1200.0, "alcc X=1": 1300.0}
    one = report(windows_for(rows(flow_vph={**FLOWS, **faster})))
    assert one.table.set_index("strategy").loc["alcc", "more_flow"] == pytest.approx(0.15, abs=0.01)
    found = [line for line in one.remarks if "not at equal flow" in line]
    assert [line.rpartition(": ")[2] for line in found] == ["network 15.4%."]
    assert not any("their flow" in line for line in report(windows_for(rows())).remarks)
    # A chosen baseline is not that of savings at equal flow.
    named = "saved at their flow: against the recorded drivers, at the flow of these; "
    for against in (None, "alcc"):
        assert (named in report(windows_for(rows()), against=against).note) == bool(against)
    slower = rows(flow_vph={**FLOWS, "alcc": 900.0, "alcc X=1": 950.0})
    less = "No saving at their flow: less flow at all points of the front: network."
    assert less in report(windows_for(slower)).remarks


def test_without_recorded_drivers_the_flow_is_that_of_the_baseline() -> None:
    windows = windows_for(rows().replace({"strategy": {"recorded": "human"}}))
    found = report(windows)
    row = found.table.set_index("strategy").loc["alcc"]
    assert row["flow_saving"] == pytest.approx(1.0 - 100.0 / 120.0)
    assert row["rule_saving"] == pytest.approx(1.0 - 100.0 / 104.0)
    label = next(x.label for x in found.rows if x.key == "flow_saving")
    assert label.strip() == "at equal flow, against simulated drivers"
    # A baseline saves nothing against itself, with a front, too.
    table = report(windows_for(rows()[lambda x: x["strategy"] != "recorded"])).table
    missing = table["flow_saving"].isna()
    assert dict(zip(table["strategy"], missing, strict=True)) == {"rule": True, "alcc": False}


def test_fronts_are_compared_by_equal_seeds() -> None:
    whole, energy = rows(), "total_path_energy_kj"
    parts = [whole[whole["strategy"] == "recorded"].assign(training_seed=np.nan)]
    for name, seed in product(NAMES[:-1], range(3)):
        one = whole[whole["strategy"] == name].assign(training_seed=seed)
        if seed < 2 or name.startswith("alcc"):  # a third seed has twice the energy
            parts.append(one.assign(**{energy: one[energy] * (1 + seed // 2)}))
    found = at_equal_flow(
        windows_for(pd.concat(parts)), ["alcc", "alcc X=1"], list(NAMES[:3]), energy, "recorded"
    )
    assert found.value == pytest.approx(1.0 - 100.0 / 104.0)
    # Trainings that are equal by seed differ by nothing, however much seeds differ.
    pair, every = ["alcc", "alcc X=1"], pd.concat(parts)
    twin = every[every["strategy"].isin(pair)].replace({"strategy": {x: f"my {x}" for x in pair}})
    both = windows_for(pd.concat([every, twin]))
    found = at_equal_flow(both, pair, [f"my {x}" for x in pair], energy, "recorded")
    assert found.low == found.value == found.high == 0.0


def test_a_strategy_that_collides_has_no_saving_and_no_flow() -> None:
    one = report(windows_for(rows(collided={"alcc": True})))
    row = one.table.set_index("strategy").loc["alcc"]
    names = ["saving", "second_saving", "flow_saving", "rule_saving", "drawn_saving"]
    names += ["flow_pct", "flow_vph"]
    assert row[names].isna().all()
    assert one.short.set_index("strategy").loc["alcc", ["saved_pct", "flow_pct"]].isna().all()
    sentence = (
        "Episodes end in a collision, so that rows have no saving and no flow: network 8 of 8; "
        "leaders brake by up to 6.0 m/s², whoever drives automated cars by up to 3.0 m/s²."
    )
    assert sentence in one.remarks
    several = report(windows_for(rows(collided={"alcc": True, "rule": True}))).remarks
    named = [line for line in several if "in a collision" in line]  # one sentence for all rows
    assert len(named) == 1
    assert "network 8 of 8" in named[0]
    assert "data 8 of 8" in named[0]


def test_nothing_is_saved_against_a_baseline_that_collides() -> None:
    one = report(windows_for(rows(collided={"recorded": True})))
    table = one.table.set_index("strategy")
    assert (table["against"] == "recorded").all()
    assert table[["saving", "second_saving", "drawn_saving", "flow_pct"]].isna().all(axis=None)
    assert any("(so none has a saving against the recorded drivers)" in x for x in one.remarks)


def test_what_episodes_end_with_is_told_from_steady_driving() -> None:
    slower = rows(total_energy_kj={"alcc": 48.0, "rule": 100.0, "recorded": 120.0})
    one = report(windows_for(slower))
    row = one.table.set_index("strategy").loc["alcc"]
    assert row["end_saving"] == pytest.approx(0.6 - (1.0 - 90.0 / 120.0))
    said = [line for line in one.remarks if line.startswith("Start and end of episodes")]
    assert [line.rpartition(": ")[2] for line in said] == ["network."]
    assert not any("Start and end" in x for x in report(windows_for(rows())).remarks)


@pytest.mark.usefixtures("blank_figures")
def test_a_front_and_a_second_energy_are_evaluated(tmp_path) -> None:
    words = [
        *("variant=idm", "+filter=cbf", "scenario.horizon=300", "evaluation.warm_up=10"),
        *("evaluation.profiles=2", "evaluation.drivers=2", "evaluation.front=[0.8,2.5]"),
        "evaluation.baselines=[human,idm_acc,idm_acc_filtered]",
    ]
    second = "+energy@evaluation.second_energy=compact"
    found = evaluation.run(load("evaluate", [*words, second]), tmp_path / "a")
    fuel = evaluation.run(load("evaluate", [*words, "energy=compact"]), tmp_path / "b")
    column = f"total_{SECOND}"
    rule = "idm_acc_filtered"
    assert found["strategy"].unique().tolist() == [
        *("human", "idm_acc", rule, "idm", f"{rule} X=0.8", f"{rule} X=2.5")
    ]
    near, far = (found[found["strategy"] == f"{rule} X={x}"] for x in ("0.8", "2.5"))
    assert (far["mean_gap_m"].to_numpy() > near["mean_gap_m"].to_numpy()).all()
    words.remove("+filter=cbf")
    bare = [*words, "evaluation.baselines=[human]"]
    with pytest.raises(ConfigError, match=r"evaluation\.front needs the safety filter"):
        strategies_of(load("evaluate", bare))
    np.testing.assert_allclose(found[column], fuel["total_path_energy_kj"], rtol=1e-5)
