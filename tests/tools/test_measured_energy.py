"""The comparison of energy models with measurements: levels, correlations and the figure."""

from __future__ import annotations

import measured_energy as tool
import numpy as np
import pandas as pd
import pytest


def bench() -> pd.DataFrame:
    """Runs of the bench, of which a tenth more is measured than modelled by one car."""
    distance = np.array([1e3, 2e3, 4e3])
    per_km = np.array([50.0, 52.0, 49.0])
    rows = {"kind": "bench", "setting": "humans", "position": [1, 2, 3], "distance_m": distance}
    rows |= {"measured": per_km * distance / 1e3}
    fuels = {
        "Compact": per_km / 1.1,
        "midBase": np.array([52.0, 50.0, 53.0]),
        "midSUV": 1.4 * per_km,
    }
    return pd.DataFrame(rows | {name: x * distance / 1e3 for name, x in fuels.items()})


def test_levels_are_of_totals_and_correlations_per_km() -> None:
    level, together = tool.agreement(bench(), "Compact")
    assert level == pytest.approx(1.0 / 1.1)
    assert together == pytest.approx(1.0)
    assert tool.agreement(bench(), "midBase")[1] < 0.0  # in totals the lengths would hide it
    assert tool.along(bench(), "measured") == pytest.approx(49.0 / 50.0)
    assert np.isnan(tool.agreement(bench()[:2], "Compact")[1])


def test_lines_name_every_kind() -> None:
    electric = {tool.ELECTRIC: 1.0, f"{tool.ELECTRIC}_bare": 0.9}
    kinds = (bench().assign(kind=kind, **electric) for kind in ("bench", "dynamometer", "battery"))
    said = "\n".join(tool.lines(pd.concat(kinds)))
    assert "bench, all, Compact: 3 runs, level 0.909, r 1.000" in said
    assert "last over first car, humans: measured 0.980" in said
