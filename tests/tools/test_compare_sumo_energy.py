"""Our electric cars against SUMO's model "Energy" with the same parameters."""

from __future__ import annotations

import pytest

pytest.importorskip("libsumo", reason="extra sumo")

from compare_sumo_energy import ELECTRIC, compared

pytestmark = pytest.mark.slow


def test_electricity_on_udds_is_that_of_sumo_within_two_percent() -> None:
    used = compared("udds").set_index("model")["electricity_wh_per_km"]
    for car in ELECTRIC:
        sumo = used[f"SUMO Energy, {car}"]
        assert used[car] / sumo == pytest.approx(1.0, abs=0.02)
        # SUMO knows no limits of recuperation, and takes the kinetic energy of a step exactly.
        assert used[f"{car}, unlimited, mid-step"] / sumo == pytest.approx(1.0, abs=0.003)
        assert used[car] > used[f"{car}, unlimited"]


def test_fuel_on_udds_is_of_the_size_of_sumos() -> None:
    used = compared("udds").set_index("model")["fuel_g_per_km"]
    for model in ("SUMO HBEFA4 petrol Euro 6ab", "SUMO PHEMlight petrol Euro 4"):
        assert 0.7 < used["midsize"] / used[model] < 1.0
