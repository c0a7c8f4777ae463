"""The comparison of energy models with measurements: levels, correlations and the figure."""

from __future__ import annotations

import measured_energy as tool
import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.image import imread

from lcc_rl.energy import CirclesFuel, ElectricCar

TIME = 0.1 * np.arange(600)


def drive(number: int) -> np.ndarray:
    return 8.0 + 0.5 * number + 3.0 * np.sin(0.2 * TIME + number)


def rates(model, speed: np.ndarray) -> np.ndarray:
    motion = (torch.from_numpy(speed), torch.from_numpy(np.gradient(speed, 0.1)))
    return model.power(*motion).numpy()


def on_the_bench(fuel: CirclesFuel) -> pd.DataFrame:
    """Three drives of which a tenth more is measured."""
    return pd.concat(
        pd.DataFrame({"setting": "humans", "position": n, "sample": 1, "time_s": TIME}).assign(
            speed_mps=drive(n), fuel_g_per_s=1.1 * rates(fuel, drive(n)) / fuel.heating_value
        )
        for n in (1, 2, 3)
    )


def trips(car: ElectricCar) -> pd.DataFrame:
    """Trips in summer and, with 2 kW of heating, in winter; each climbs 3 m."""
    lift = car.mass * 9.81 * 3.0 / car.efficiency / 60.0
    return pd.concat(
        pd.DataFrame({"trip": f"{place}{n}", "time_s": TIME, "speed_mps": drive(n)}).assign(
            elevation_m=np.linspace(0.0, 3.0, len(TIME)),
            battery_v=350.0,
            battery_a=-(rates(car, drive(n)) + heating + lift) / 350.0,
            heating_kw=heating / 1e3,
            aircon_kw=np.nan,
            ambient_c=warm,
        )
        for n in (1, 2, 3)
        for place, warm, heating in (("A", 25.0, 0.0), ("B", 0.0, 2000.0))
    )


def on_the_dynamometer(fuel: CirclesFuel) -> pd.DataFrame:
    """A drive from 0 to 30 m/s and back, above 21 m/s with a fifth less fuel than the model's."""
    speed = 15.0 - 15.0 * np.cos(TIME / 5.0)
    grams = rates(fuel, speed) / fuel.heating_value * np.where(speed > 21.0, 0.8, 1.0)
    rows = pd.DataFrame({"time_s": TIME, "speed_mps": speed, "fuel_ccps": grams / tool.PETROL})
    return rows.assign(test="one")


def test_what_was_measured_by_a_model_is_that_model(tmp_path, capsys) -> None:
    bench, electric = tmp_path / "bench.parquet", tmp_path / "trips.parquet"
    on_the_bench(CirclesFuel(vehicle="Compact")).to_parquet(bench)
    trips(ElectricCar()).to_parquet(electric)
    dynamometer = tmp_path / "dynamometer.csv"
    on_the_dynamometer(CirclesFuel(vehicle="Compact")).to_csv(dynamometer, index=False)
    given = ["--bench", str(bench), "--electric", str(electric)]
    given += ["--dynamometer", str(dynamometer)]
    files = ["--kept", str(tmp_path / "kept.parquet"), "--figure", str(tmp_path / "drawn.png")]
    assert tool.main([*given, *files]) == 0
    said = capsys.readouterr().out
    table = pd.read_parquet(tmp_path / "kept.parquet").set_index("kind")
    level, together = tool.agreement(table.loc["bench"], "Compact")
    assert level == pytest.approx(1 / 1.1, rel=0.01)
    assert together > 0.999
    assert tool.agreement(table.loc["bench"], "midBase")[0] > 1.05 * level
    assert tool.along(table.loc["bench"], "measured") == pytest.approx(
        tool.along(table.loc["bench"], "Compact"), rel=0.01
    )
    battery = table.loc["battery"]
    assert tool.agreement(battery, tool.ELECTRIC)[0] == pytest.approx(1.0, rel=0.01)
    winter = battery[battery["setting"] == "winter"]
    assert tool.agreement(winter, f"{tool.ELECTRIC}_bare")[0] < 0.85
    driven = table.loc["dynamometer"].set_index("setting")
    levels = driven["Compact"] / driven["measured"]
    assert levels.tolist() == pytest.approx([1.0, 1.0, 1.25], rel=0.01)
    assert f"bench, all, Compact: 3 runs, level {level:.3f}" in said
    assert tool.main(["--draw", *files]) == 0
    assert capsys.readouterr().out == said
    pixels = imread(tmp_path / "drawn.png")[..., :3].reshape(-1, 3)
    assert len(np.unique((255 * pixels).astype(int), axis=0)) > 100
