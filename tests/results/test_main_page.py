"""The headline of the main job: the right numbers, in order, and no sentinel value."""

import numpy as np
import pytest
from rich.console import Console
from study_frames import episodes

from lcc_rl.config import load
from lcc_rl.figures.main_page import AGAINST, CAPTION, as_rich, caption_of, headline
from lcc_rl.results.tables import summary


@pytest.fixture(scope="module")
def found():
    return summary(episodes())


def test_who_draws_most_stands_first_and_rows_equal_the_summary(found) -> None:
    table = headline(found)
    cars = found.set_index("strategy").loc[table["strategy"]]
    assert "direct" not in set(table["strategy"])
    assert table["path_energy_kj"].is_monotonic_decreasing
    np.testing.assert_array_equal(table["path_energy_kj"], cars["total_path_energy_kj"])
    for baseline in (name for name in AGAINST if name in cars.index):
        column = f"saved_against_{baseline.replace(' ', '_')}_pct"
        own = table.loc[table["strategy"] == baseline, column]
        assert own.isna().all()
        saved = 100.0 * cars[f"path_saving_vs_{baseline}"]
        np.testing.assert_array_equal(table[column], saved)


def test_the_terminal_shows_a_dash_where_nothing_is_compared(found) -> None:
    console = Console(width=120)
    table = headline(found)
    table["saved_against_human_pct"] = [np.nan, *([1.0] * (len(table) - 1))]
    table["saved_against_human_pct_low"] = table["saved_against_human_pct_high"] = 1.0
    with console.capture() as shown:
        console.print(as_rich(table, "title [x]"))
    text = shown.get()
    assert "title [x]" in text
    assert "–" in text
    assert "nan" not in text


def test_the_caption_says_what_limit_the_networks_keep() -> None:
    limited = load("train", ["variant=alcc", "experiment=main"])
    literal = load("train", ["variant=alcc"])
    assert "agent.limits.efficiency=0.01 of the time" in caption_of([limited, literal])
    assert caption_of([literal]) == CAPTION
