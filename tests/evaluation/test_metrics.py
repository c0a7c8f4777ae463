"""Measures of an episode against values worked out by hand."""

import pytest
import torch

from lcc_rl.energy import AVERAGED, as_fleet
from lcc_rl.evaluation.metrics import (
    ROAD_METRICS,
    Reductions,
    averaged_energies,
    damping_time,
    energy_measures,
    safety_measures,
    string_measures,
)
from lcc_rl.evaluation.rows import grouped
from lcc_rl.functional.pattern import parse_string
from lcc_rl.results.measures import limit_measures

ALIVE = torch.tensor([[True, True], [True, False]])  # two steps; the second episode ends early


def test_energy_counts_only_the_running_steps() -> None:
    power = torch.tensor([[1000.0, 2000.0], [3000.0, 9000.0]])
    speed = torch.tensor([[10.0, 10.0], [11.0, 12.0], [12.0, 99.0]])
    measures = energy_measures(power, speed, ALIVE, 0.1)
    # (1000 + 3000)·0.1 J = 0.4 kJ; 2000·0.1 = 0.2 kJ.
    torch.testing.assert_close(measures["energy_kj"], torch.tensor([0.4, 0.2]))
    # ½·1.02·1005·(12² − 10²) = 22552.2 J; the second ends at 12 m/s after its only step, too.
    torch.testing.assert_close(measures["net_energy_kj"], torch.tensor([0.4, 0.2]) - 22.5522)
    # (10.5 + 11.5)·0.1 = 2.2 m; 11·0.1 = 1.1 m.
    torch.testing.assert_close(measures["distance_m"], torch.tensor([2.2, 1.1]))
    # (2911 + 25.19 v)·a² at 10 and 11 m/s with 10 m/s²; the second with 20 m/s² at 10 m/s.
    first = ((2911 + 251.9) * 100 + (2911 + 277.09) * 100) * 0.1 / 1e3
    second = (2911 + 251.9) * 400 * 0.1 / 1e3
    torch.testing.assert_close(measures["acceleration_loss_kj"], torch.tensor([first, second]))


def test_averaged_energies_leave_noise_out_and_count_the_whole_way() -> None:
    time = 0.1 * torch.arange(300).view(-1, 1, 1, 1)
    even = (10.0 + 0.05 * time).expand(300, 2, 1, 1)
    jitter = 0.1 * (-1.0) ** torch.arange(300).view(-1, 1, 1, 1)
    alive = torch.ones(299, 2, 1, 1, dtype=torch.bool)
    alive[100:, 1] = False  # the second episode ends early

    def driven(speed: torch.Tensor) -> dict[str, torch.Tensor]:
        power = as_fleet(None).power(speed[:-1], speed.diff(dim=0) / 0.1)
        raw = energy_measures(power, speed, alive, 0.1)
        return raw | averaged_energies(speed, alive, 0.1)

    smooth, noisy = driven(even), driven(even + jitter)
    assert (noisy["path_energy_kj"] > 3.0 * smooth["path_energy_kj"]).all()
    for name in AVERAGED:
        torch.testing.assert_close(smooth[name], smooth["path_energy_kj"], rtol=5e-3, atol=0.0)
        torch.testing.assert_close(noisy[name], smooth[name], rtol=0.1, atol=0.0)
    assert averaged_energies(even[:20], alive[:19], 0.1)[AVERAGED[1]].isnan().all()


def test_safety() -> None:
    # [time, episodes, vehicles, 1]: one vehicle in each of two episodes.
    series = {
        "ttc": torch.tensor([[3.0, 5.0], [1e3, 0.01]]),
        "time_gap": torch.tensor([[2.6, 1.0], [1.0, 9.0]]),
        "gap": torch.tensor([[8.0, 3.0], [7.0, -1.0]]),
        "jerk": torch.tensor([[3.0, 2.0], [4.0, 50.0]]),
    }
    series = {name: value.view(2, 2, 1, 1) for name, value in series.items()}
    # Before the first step, and after each: the long time gap is one of a crawling vehicle.
    series["speed"] = torch.tensor([[9.0, 9.0], [0.5, 9.0], [9.0, 9.0]]).view(3, 2, 1, 1)
    measures = safety_measures(series, ALIVE.view(2, 2, 1, 1), 0.1)
    expected = {
        "min_gap_m": [7.0, 3.0],
        "mean_gap_m": [7.5, 3.0],
        "gap_opened_m": [-1.0, 0.0],
        "max_gap_m": [8.0, 3.0],
        "min_time_gap_s": [1.0, 1.0],
        "min_ttc_s": [3.0, 5.0],
        "max_time_gap_s": [2.6, 1.0],
        "share_ttc_unsafe": [0.5, 0.0],
        "share_time_gap_long": [0.5, 0.0],
        "share_time_gap_long_moving": [0.0, 0.0],
        "rms_jerk_mps3": [12.5**0.5, 2.0],  # √((9 + 16)/2)
        "max_jerk_mps3": [4.0, 2.0],
        "max_deceleration_1s_mps2": [torch.nan, torch.nan],  # the episodes are shorter
        "standstill_gap_m": [torch.nan, torch.nan],
        "standstill_s": [torch.nan, torch.nan],
        "duration_s": [0.2, 0.1],
    }
    assert set(measures) == set(expected)
    named = {name for name in expected if name.startswith(("max_", "min_", "share_"))}
    filtered = {"share_ttc_unpromised", "share_turned_unsafe"}
    others = {"share_leader_faster", "share_time_gap_short", "flow_vph", "mean_speed_mps"}
    others |= {"rms_jerk_mps3"}
    braking = {"max_deceleration_mps2", "max_jerk_1s_mps3"}  # of accelerations
    named |= {"standstill_gap_m"}
    assert named | others | filtered | braking == set(limit_measures())
    for name, values in expected.items():
        torch.testing.assert_close(measures[name].flatten(), torch.tensor(values), equal_nan=True)


def test_braking_and_overshoot_as_standards_name_them() -> None:
    # Two vehicles brake from 10 m/s by 5 and 2 m/s² after 1 s; the second episode ends before.
    time = torch.arange(81) * 0.1
    speed = torch.stack(
        [(10.0 - a * (time - 1.0).clamp(min=0.0)).clamp(min=0.0) for a in (5.0, 2.0)]
    )
    speed = speed.T.reshape(81, 1, 2, 1).repeat(1, 2, 1, 1)
    acceleration = speed.diff(dim=0) / 0.1
    # The first counted step changes the acceleration from 8 m/s²: a window of its own.
    jerk = torch.cat([torch.full((1, 2, 2, 1), -80.0), acceleration.diff(dim=0) / 0.1])
    gap = torch.linspace(40.0, 0.0, 80).view(80, 1, 1, 1).expand(80, 2, 2, 1)
    leader = (9.0 - 0.1 * time).view(81, 1, 1, 1).expand(81, 2, 1, 1)
    alive = torch.ones(80, 2, 1, 1, dtype=torch.bool)
    alive[9:, 1] = False
    series = {"speed": speed, "acceleration": acceleration, "jerk": jerk, "gap": gap}
    series["leader_highest"] = leader.cummax(0).values
    found = safety_measures(series, alive, 0.1)
    expected = {
        "max_deceleration_mps2": [5.0, 0.0],
        "max_deceleration_1s_mps2": [5.0, torch.nan],
        "max_jerk_mps3": [80.0, 80.0],
        "max_jerk_1s_mps3": [8.0, torch.nan],
        "standstill_gap_m": [0.0, torch.nan],
        "standstill_s": [6.0, torch.nan],  # of the last vehicle
        "speed_overshoot_mps": [1.0, 1.0],
    }
    for name, values in expected.items():
        close = {"atol": 1e-3, "rtol": 1e-3, "equal_nan": True}
        torch.testing.assert_close(found[name].flatten(), torch.tensor(values), **close)
    standing = {name: entry[70:] for name, entry in series.items()}
    assert (standing["speed"] == 0.0).all()
    found = safety_measures(standing, alive[70:], 0.1)
    assert found["standstill_s"].isnan().all()
    assert found["standstill_gap_m"].isnan().all()


def test_safety_of_many_vehicles_is_that_of_the_worst_and_shares_are_means() -> None:
    series = {
        "ttc": torch.tensor([[3.0, 5.0], [1e3, 2.0]]),
        "time_gap": torch.tensor([[2.6, 1.0], [1.0, 1.0]]),
        "gap": torch.tensor([[8.0, 3.0], [7.0, 4.0]]),
        "jerk": torch.tensor([[3.0, 0.0], [4.0, 0.0]]),
    }
    series = {name: value.view(2, 1, 2, 1) for name, value in series.items()}
    series["speed"] = torch.full((3, 1, 2, 1), 9.0)
    measures = safety_measures(series, torch.ones(2, 1, 1, 1, dtype=torch.bool), 0.1)
    found = {name: float(value) for name, value in measures.items()}
    assert found["min_gap_m"] == 3.0
    assert found["min_ttc_s"] == 2.0
    assert found["max_time_gap_s"] == pytest.approx(2.6)
    # Unsafe in half of the time each; too long in half of one's time.
    assert found["share_ttc_unsafe"] == pytest.approx(0.5)
    assert found["share_time_gap_long"] == pytest.approx(0.25)
    assert found["share_time_gap_long_moving"] == pytest.approx(0.25)


def test_traffic_of_a_string() -> None:
    # [time, episodes, vehicles, 1]; the second episode ends after two steps.
    one = torch.tensor([[10.0, 12.0], [12.0, 12.0], [10.0, 12.0], [12.0, 12.0]])
    other = torch.tensor([[5.0, 7.0], [5.0, 9.0], [50.0, 90.0], [50.0, 90.0]])
    speed = torch.stack([one, other], 1).unsqueeze(-1)
    alive = torch.tensor([[1, 1], [1, 1], [1, 0], [1, 0]], dtype=torch.bool).unsqueeze(-1)
    leader = torch.tensor([[8.0, 1.0], [12.0, 3.0], [8.0, 0.0], [12.0, 0.0]]).unsqueeze(-1)
    gap = torch.full_like(speed, 15.0)
    found = string_measures(speed, gap, alive, 5.0, leader)
    expected = {
        "mean_speed_mps": [11.5, 6.5],
        "speed_std_mps": [0.5, 0.5],
        "speed_spread_mps": [0.5, 1.5],
        "final_speed_spread_mps": [0.0, 2.0],
        "flow_vph": [3600.0 * 11.5 / 20.0, 3600.0 * 6.5 / 20.0],
        "string_ratio": [0.0, 1.0],
    }
    assert set(found) == set(expected)
    for name, values in expected.items():
        torch.testing.assert_close(found[name].flatten(), torch.tensor(values))
    assert "string_ratio" not in string_measures(speed, gap, alive, 5.0)
    # Spreads of 1, 0, 1, 0 m/s, then none above 0.5; the other one still varies when it ends.
    torch.testing.assert_close(
        damping_time(speed, alive, 0.1).flatten(), torch.tensor([0.3, torch.nan]), equal_nan=True
    )


def test_a_filter_acts_where_its_command_is_not_what_it_was_told() -> None:
    one = torch.ones(4, 1, 1, 1)
    series = dict.fromkeys(("ttc", "time_gap", "gap", "jerk"), one)
    series |= {"speed": torch.full((5, 1, 1, 1), 9.0), "wanted": one}
    series["command"] = torch.tensor([1.0, 0.5, 1.001, -3.0]).view(4, 1, 1, 1)
    found = safety_measures(series, torch.tensor([1, 1, 1, 0]).bool().view(4, 1, 1, 1), 0.1)
    assert found["share_filter_acts"].item() == pytest.approx(1 / 3)


def test_every_string_has_the_places_of_its_automated_vehicles() -> None:
    record = {("vehicles", "speed"): torch.arange(8.0).view(2, 1, 4, 1)}
    groups = grouped(record, parse_string("human automated human automated"))
    assert groups["cav"]["place"].tolist() == [[[1, 3]]] * 2
    assert groups["cav"]["speed"].flatten(1).tolist() == [[1.0, 3.0], [5.0, 7.0]]


def test_what_a_road_asks_of_all_vehicles() -> None:
    # Two vehicles, steps of 0.5 s: the first brakes hard three times, the second time within a
    # second of the first; the second vehicle once.
    own = torch.tensor([-2.5, -1.0, -2.5, 0.0, 0.0, -3.5])
    acceleration = torch.stack([own, torch.tensor([0.0] * 5 + [-9.0])], 1).view(6, 1, 2, 1)
    alive = torch.ones(6, 1, 1, 1, dtype=torch.bool)
    series = {
        "acceleration": acceleration,
        "gap": torch.ones(6, 1, 2, 1),
        "time_gap": torch.tensor([0.9, 1.1]).view(1, 1, 2, 1).expand(6, 1, 2, 1),
        "speed": torch.full((7, 1, 2, 1), 20.0),
        "free": torch.full((1, 1, 1), 25.0),
    }
    found = safety_measures(series, alive, 0.5, ROAD_METRICS)
    expected = {
        "brakings_below_2": 3.0,  # steps 0 and 5 of the first, step 5 of the second
        "brakings_below_3": 2.0,
        "share_time_gap_short": 0.5,
        "vehicle_time_s": 6.0,
        "delay_s": 1.2,  # 6 s − 120 m over 25 m/s
    }
    assert {name: pytest.approx(float(x)) for name, x in found.items()} == expected
    alive[5] = False
    found = safety_measures(series, alive, 0.5, ROAD_METRICS)
    assert float(found["brakings_below_2"]) == 1.0


def test_reductions_of_speeds_end_with_the_episode() -> None:
    # Speeds 0 to 5 with the one before the first step; the second episode ends after 3 of 5 steps.
    speed = torch.arange(6.0).reshape(6, 1, 1, 1).expand(6, 2, 1, 1)
    alive = torch.ones(5, 2, 1, 1, dtype=torch.bool)
    alive[3:, 1] = False
    over = Reductions(alive, 1.0)
    assert over.highest(speed).flatten().tolist() == [5.0, 3.0]
    assert over.change(speed).flatten().tolist() == [5.0, 3.0]
    assert over.lowest(5.0 - speed).flatten().tolist() == [0.0, 2.0]
    assert over.highest(speed[3:]).flatten().tolist() == [5.0, 3.0]  # without the first times
