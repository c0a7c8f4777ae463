"""Driver populations: shapes, draws, densities, and tables that must be refused."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from helpers import check_refused

from lcc_rl.drivers.population import bootstrap, fixed, from_table, load_drivers
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.functional.driver_models import Reaction
from lcc_rl.functional.idm import IDMConstants
from lcc_rl.functional.laws import LAWS
from lcc_rl.io.files import parquet_metadata


@pytest.fixture
def table() -> pd.DataFrame:
    """The first 20 shipped drivers."""
    return load_drivers().head(20)


@pytest.fixture
def written(tmp_path):
    """Function that writes a table and returns its path."""

    def write(frame):
        path = tmp_path / "drivers.parquet"
        frame.to_parquet(path)  # whatever it holds
        return path

    return write


def test_shipped_population_is_the_published_one():
    population = bootstrap()
    assert len(population) == 249
    assert population.desired_speed.shape == population.time_gap.shape == (249,)
    assert population.desired_speed.dtype == torch.float32
    assert population.constants == IDMConstants()
    assert len(set(population.ids)) == 249
    summary = population.summary()
    assert float(population.time_gap.mean()) == pytest.approx(1.33, abs=0.01)
    assert summary["correlation"] == pytest.approx(0.15, abs=0.01)
    assert summary["share_at_bound"] == pytest.approx(0.386, abs=0.01)


def test_shipped_table_says_where_it_comes_from():
    from importlib import resources

    with resources.as_file(resources.files("lcc_rl.assets") / "i80_drivers.parquet") as path:
        assert "NGSIM I-80" in parquet_metadata(path)["provenance"]
        assert not [
            name for name in pd.read_parquet(path) if "position" in name or "time_s" in name
        ]


def test_global_population_has_constants_of_its_own():
    population = bootstrap(mode="global")
    assert population.constants.acceleration.shape == (249,)
    chosen = population.select(torch.tensor([3, 3, 7]))
    assert chosen.constants.min_gap.tolist() == [
        population.constants.min_gap[place].item() for place in (3, 3, 7)
    ]
    assert chosen.ids == tuple(population.ids[place] for place in (3, 3, 7))


def test_drivers_of_several_models_are_a_population(table, written):
    table = table.assign(model=["idm", "gipps"] * 10)
    table["leader_deceleration_mps2"] = np.where(table["model"] == "gipps", 2.8, np.nan)
    population = bootstrap(written(table))
    assert population.models == tuple(table["model"])
    assert population.constants == IDMConstants()
    own = population.parameters()
    assert set(own) == {*LAWS["idm"].table(), *LAWS["gipps"].table()}
    expected = table["leader_deceleration_mps2"].to_numpy()
    np.testing.assert_allclose(own["leader_deceleration"], expected, rtol=1e-6)
    with pytest.raises(DataError, match="row 1, column 'leader_deceleration_mps2'"):
        from_table(table.assign(leader_deceleration_mps2=99.0))


def test_a_table_says_how_its_drivers_react(table, written):
    reacting = table.assign(reaction_delay_s=0.7, acceleration_noise_mps2=0.2)
    assert bootstrap(written(table)).reaction == Reaction()
    assert bootstrap(written(reacting)).reaction == Reaction(0.7, 0.2)
    assert bootstrap(written(reacting), acceleration_noise=0.0).reaction == Reaction(0.7, 0.0)
    reacting.loc[3, "reaction_delay_s"] = 0.5
    with pytest.raises(DataError, match=r"s\.parquet: column 'reaction_delay_s' must be 0 to 3, "):
        bootstrap(written(reacting))


def test_tables_of_one_mode_or_none_are_read(table, written):
    assert len(load_drivers(written(table))) == 20
    assert len(bootstrap(written(table.drop(columns=["mode", "recording"])))) == 20
    with pytest.raises(DataError, match="no drivers of mode 'global'"):
        load_drivers(written(table), mode="global")


def test_bad_tables_end_in_one_clear_error(table, written) -> None:
    check_refused(
        lambda change: load_drivers(written(change(table))),
        [
            (lambda t: t.iloc[:0], "no drivers"),
            (lambda t: t.drop(columns="time_gap_s"), r"drivers\.parquet: missing.*time_gap_s"),
            (lambda t: t.assign(time_gap_s="x"), "'time_gap_s' is not numeric"),
            (
                lambda t: t.assign(time_gap_s=t["time_gap_s"].where(t.index != 4)),
                "row 4.*time_gap_s",
            ),
            (lambda t: t.assign(min_gap_m=-2.0), "row 0.*min_gap_m.*must be 0.05 to 50, got -2"),
            (lambda t: t.assign(model="wiedemann"), "row 0, column 'model'.*got 'wiedemann'"),
            (lambda t: pd.concat([t, t.iloc[3:5]], ignore_index=True), "row 20: a driver .* twice"),
        ],
        DataError,
    )


def test_no_driver_is_like_that() -> None:
    check_refused(
        lambda call: call(),
        [
            (lambda: bootstrap(least_speed=1e6), "desired_speed"),
            (lambda: fixed(desired_speed=-1.0), "desired_speed"),
            (lambda: fixed(desired_speed=90.0), "'desired_speed' must be 1 to 70, got 90"),
            (lambda: fixed(time_gap=np.inf), "time_gap"),
            (lambda: fixed(min_gap=0.0), "min_gap"),
            (lambda: replace(fixed(), ids=()), "no drivers"),
            (lambda: bootstrap(reaction_delay=50.0), "reaction delay must be 0 to 3, got 50"),
            (lambda: fixed(acceleration_noise=9.0), "reaction noise must be 0 to 3, got 9"),
        ],
        ConfigError,
    )
