"""Savings at equal flow, of a second energy model, and of strategies that collide or end slower."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from lcc_rl.commands import evaluation
from lcc_rl.config import load
from lcc_rl.energy import SECOND
from lcc_rl.results.fronts import at_equal_flow
from lcc_rl.results.report import report, summary, windows_for

WINDOWS = 8
FLOWS = {"rule": 1000.0, "rule T=1": 1100.0, "rule T=2": 900.0, "alcc": 1040.0, "recorded": 1050.0}
ENERGIES = {"rule": 100.0, "rule T=1": 110.0, "rule T=2": 96.0, "alcc": 99.0, "recorded": 120.0}


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


def test_a_strategy_is_compared_with_the_front_at_its_flow() -> None:
    table = summary(windows_for(rows())).set_index("strategy")
    assert list(table.index) == ["rule", "alcc", "recorded"]  # not the points of the front
    # Between T = 1 and 2 s at 1,040 vehicles per hour: 96 + 0.7 (110 - 96) = 105.8 kJ.
    found = table.loc["alcc"]
    assert found["rule_saving"] == pytest.approx(1.0 - 99.0 / 105.8)
    assert found["rule_saving_low"] <= found["rule_saving"] <= found["rule_saving_high"]
    assert found["against"] == "recorded"
    assert found["saving"] == pytest.approx(1.0 - 99.0 / 120.0)
    assert found["second_saving"] == pytest.approx(found["saving"])
    fast = at_equal_flow(windows_for(rows()), "recorded", ["rule T=2"], "total_path_energy_kj")
    assert np.isnan(fast.value)  # beyond the front


def test_a_strategy_that_collides_has_no_saving_and_no_flow() -> None:
    one = report(windows_for(rows(collided={"alcc": True})))
    row = one.table.set_index("strategy").loc["alcc"]
    names = ["saving", "second_saving", "rule_saving", "drawn_saving", "flow_lost", "flow_vph"]
    assert row[names].isna().all()
    assert one.short.set_index("strategy").loc["alcc", ["saved_pct", "flow_pct"]].isna().all()
    sentence = (
        "network: 8 of 8 episodes end in a collision, so it has no saving and no flow; leaders "
        "brake by up to 6.0 m/s², automated vehicles by up to 3.0 m/s²."
    )
    assert sentence in one.remarks


def test_what_episodes_end_with_is_told_from_steady_driving() -> None:
    slower = rows(total_energy_kj={"alcc": 60.0, "rule": 100.0, "recorded": 120.0})
    one = report(windows_for(slower))
    row = one.table.set_index("strategy").loc["alcc"]
    assert row["end_saving"] == pytest.approx(0.5 - (1.0 - 99.0 / 120.0))
    said = [line for line in one.remarks if "begins and ends with" in line]
    assert len(said) == 1
    assert "network +17.5 and +32.5 %" in said[0]
    assert not any("begins and ends" in x for x in report(windows_for(rows())).remarks)


@pytest.mark.usefixtures("blank_figures")
def test_a_front_and_a_second_energy_are_evaluated(tmp_path) -> None:
    words = [
        *("variant=idm", "+filter=cbf", "scenario.horizon=60", "evaluation.warm_up=1"),
        *("evaluation.profiles=2", "evaluation.drivers=2", "evaluation.front=[1.0,2.5]"),
        "evaluation.baselines=[human,idm_acc]",
    ]
    second = "+energy@evaluation.second_energy=compact"
    found = evaluation.run(load("evaluate", [*words, second]), tmp_path / "a")
    fuel = evaluation.run(load("evaluate", [*words, "energy=compact"]), tmp_path / "b")
    column = f"total_{SECOND}"
    assert found["strategy"].unique().tolist() == [
        *("human", "idm_acc", "idm", "idm_acc T=1", "idm_acc T=2.5")
    ]
    near, far = (found[found["strategy"] == f"idm_acc T={x}"] for x in ("1", "2.5"))
    assert (far["mean_gap_m"].to_numpy() > near["mean_gap_m"].to_numpy()).all()
    np.testing.assert_allclose(found[column], fuel["total_path_energy_kj"], rtol=1e-5)
