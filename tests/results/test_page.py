"""The page: escaped, self-contained, numbers with units and intervals; the main job's headline."""

from __future__ import annotations

import base64
import re
from io import BytesIO

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from rich.console import Console
from study_frames import episodes

from lcc_rl.api import Run
from lcc_rl.config import load
from lcc_rl.figures.drawing import new_figure, save
from lcc_rl.figures.page import Page
from lcc_rl.io.files import processor, read_parquet, write_parquet
from lcc_rl.results.cells import as_markdown, heading
from lcc_rl.results.headline import as_rich, caption_of, headline, sample_of, verdict
from lcc_rl.results.means import Means
from lcc_rl.results.names import in_words, worded
from lcc_rl.results.tables import summary
from lcc_rl.studies.results import StudyResults

TABLE = pd.DataFrame(
    {
        "strategy": ["alcc", "<b>"],
        "saving_pct": [4.384, -1.0],
        "saving_pct_low": [4.1, np.nan],
        "saving_pct_high": [4.6, np.nan],
        "episodes": [4980, 12],
        "total_energy_kj": [270.123, np.nan],
        "within_limits": [True, False],
    }
)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    figure = new_figure(2.0, 1.0)
    figure.subplots().plot([0, 1], [0, 1])
    made = Page(tmp_path_factory.mktemp("page"))
    write_parquet(pd.DataFrame({"a": [1]}), made.folder / "run" / "training.parquet")
    drawn = save(figure, made.folder / "line.png")
    made.add("First & last", "One < two.\n\nNext.", [("A table", TABLE)], [("A line", drawn)])
    made.write("A job", ["lcc-rl run"])
    return made


def test_a_page_holds_everything_and_fetches_nothing(page) -> None:
    html = (page.folder / "report.html").read_text()
    links = re.findall(r'(?:src|href|action)="([^"]*)"', html)
    assert all(link.startswith(("#", "data:image/")) for link in links)
    assert not re.search(r"<script|<link|url\(|@import|https?://", html)
    assert "default-src 'none'" in html
    assert html.count("<table>") == 2
    assert html.count("<details>") == 1
    for words in (
        "First &amp; last",
        "One &lt; two.</p>",
        "lcc-rl run",
        "<td>torch</td>",
    ):
        assert words in html
    assert f"Its trainings ran on: {processor()} (1)." in html


def test_cells_are_formatted_for_readers(page) -> None:
    html = (page.folder / "report.html").read_text()
    for cell in ("4.38 (4.10 … 4.60)", "−1.00", "4,980", "270.1"):
        assert f'<td class="number">{cell}</td>' in html
    for cell in ("<th>strategy</th>", "saving [%]</th>", "<td>yes</td>", ">–</td>", "&lt;b&gt;"):
        assert cell in html
    assert "saving pct low" not in html
    assert heading("energy_kj_per_km") == "energy [kJ/km]"
    assert (
        as_markdown(TABLE).splitlines()[2] == "| alcc | 4.38 (4.10 … 4.60) | 4,980 | 270.1 | yes |"
    )


def test_pictures_keep_every_pixel(page) -> None:
    html = (page.folder / "report.html").read_text()
    (data,) = re.findall(r"data:image/webp;base64,([^\"]+)", html)
    shown = Image.open(BytesIO(base64.b64decode(data))).convert("RGBA")
    assert shown.tobytes() == Image.open(page.folder / "line.png").convert("RGBA").tobytes()


def test_a_study_writes_files_and_fills_marked_tables(tmp_path) -> None:
    figure = new_figure(2.0, 1.0)
    made = StudyResults(tmp_path, ["svg"])
    made.table("energies", "A table", TABLE)
    made.figure("line", "A line", figure)
    assert (tmp_path / "figures" / "line.svg").exists()
    pd.testing.assert_frame_equal(read_parquet(tmp_path / "tables" / "energies.parquet"), TABLE)
    text = made.write("A study").read_text()
    assert "![A line](figures/line.png)" in text
    assert as_markdown(worded(TABLE)) in text


def test_the_headline_is_the_summary_and_those_that_draw_most_stand_first() -> None:
    found = summary(episodes())
    table = headline(found)
    cars = found.set_index("strategy").loc[table["strategy"]]
    assert list(table["strategy"]) == ["idm", "alcc", "reference"]
    np.testing.assert_array_equal(table["energy_kj_per_km"], cars["path_energy_kj_per_km"])
    # Who falls back gains nothing by it: alcc drives 290 m, the others 300 m.
    per_km = cars["total_path_energy_kj"] / np.array([0.3, 0.29, 0.3])
    np.testing.assert_allclose(table["energy_kj_per_km"], per_km)
    saved = 1.0 - per_km["alcc"] / per_km["reference"]
    assert cars.loc["alcc", "km_saving_vs_reference"] == pytest.approx(saved)
    means = Means.of(episodes()).per_km()  # of the figures by driver
    shown = means.saving("total_path_energy_kj", "alcc", "reference")
    assert shown.value == pytest.approx(saved)
    by_driver = means.drivers.groupby("strategy")["total_path_energy_kj"].mean()
    np.testing.assert_allclose(by_driver[table["strategy"]], per_km)
    assert verdict(found) == ""  # nobody to compare with
    assert table.attrs["against"] == "idm"
    own = cars.loc["alcc", "km_saving_vs_idm"]
    assert table["saved_pct"].tolist()[1] == pytest.approx(100.0 * own)
    assert table["distance_pct"].tolist() == pytest.approx([0.0, -100.0 / 30.0, 0.0])


def test_humans_alone_have_a_row_and_none_beside_controlled_cars() -> None:
    humans = episodes()[lambda rows: rows["strategy"] == "direct"].assign(cav_distance_m=np.nan)
    (row,) = headline(summary(humans)).to_dict("records")
    assert row["who"] == "no automated car"
    assert row["energy_kj_per_km"] == pytest.approx(humans["hdv_path_energy_kj"].mean() / 0.15)
    assert "direct" not in headline(summary(episodes()))["strategy"].tolist()


def test_every_table_of_strategies_fits_80_columns() -> None:
    table = headline(summary(episodes(profiles=8).replace({"strategy": {"idm": "human"}})))
    table["saved_pct"], table["saved_pct_low"], table["saved_pct_high"] = -9.3, -10.8, -8.1
    console = Console(width=200)
    with console.capture() as shown:
        console.print(as_rich(table, "title [x]", caption_of(table)))
    lines = shown.get().splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 80
    assert "title [x]" in lines[0]
    assert "−9.3 (−10.8 … −8.1)" in shown.get()
    assert "saved: against simulated drivers" in " ".join(shown.get().split())
    assert "nan" not in shown.get()


def test_names_are_words_in_tables_and_figures() -> None:
    words = {
        "alcc": "network, for all",
        "alcc analytic": "network, for all (analytic)",
        "idm_acc": "tuned IDM",
        "my_pid_filtered": "my_pid, filtered",
        "idm 1.1": "idm 1.1",
    }
    assert {name: in_words(name) for name in words} == words


def test_the_verdict_says_what_came_out_and_how_sure_it_is() -> None:
    frame = episodes(profiles=12).replace({"strategy": {"idm": "rule", "reference": "human"}})
    frame["total_path_energy_kj"] += np.random.default_rng(0).normal(size=len(frame))
    found = summary(frame)
    own, rule = (found.set_index("strategy").loc[x] for x in ("alcc", "rule"))
    saved = 100.0 * (1.0 - own["path_energy_kj_per_km"] / rule["path_energy_kj_per_km"])
    words = verdict(found)
    assert words.startswith(
        f"With the network, for all, energy per vehicle and km is {saved:.1f} % ("
    )
    assert "less than with IDM, tuned on these data; long time gaps: 0.40 % of" in words
    assert "within the uncertainty" in verdict(found.assign(km_saving_vs_rule_low=-1.0))
    # So has a network of any name, and each of several.
    frame.loc[frame["strategy"] == "human", "training_seed"] = np.nan
    both = [frame.replace({"strategy": {"alcc": name}}) for name in ("near", "far")]
    found = summary(pd.concat(both).drop_duplicates())
    first, second, least = verdict(found).splitlines()
    most = headline(found).iloc[-1]
    assert least == f"Least energy: {most['who']}, {most['energy_kj_per_km']:,.1f} kJ/km."
    assert first == words.splitlines()[0].replace("the network, for all", "near", 1)
    assert second.startswith("With far, energy")
    assert sample_of(frame) == f"12 held-out windows × {frame['driver_id'].nunique()} drivers"
    few = verdict(summary(frame[frame["profile_id"] < 4]))
    assert few.endswith("; 4 windows allow no finding.")
    assert "%" not in few
    assert verdict(summary(frame[frame["profile_id"] < 4]), of_few=False) == ""


def test_the_table_of_an_evaluation_ends_with_the_verdict(tmp_path, capsys) -> None:
    cfg = load("evaluate", ["variant=alcc"])
    frame = episodes(profiles=12).replace({"strategy": {"idm": "rule", "reference": "human"}})
    run = Run(tmp_path, frame, cfg)
    assert " less than with IDM, tuned on these data" in " ".join(run.printed().split())
    few = Run(tmp_path, frame[frame["profile_id"] < 4], cfg)
    assert "allow no finding" not in few.printed()


def test_one_strategy_is_compared_with_nobody_and_one_window_has_no_interval() -> None:
    frame = episodes(profiles=12)
    alone = headline(summary(frame[frame["strategy"] == "idm"]))
    assert alone.attrs["against"] is None
    assert not {"saved_pct", "distance_pct"} & set(alone)
    assert "saved" not in alone.attrs["caption"]
    assert "with the 95 % interval" in headline(summary(frame)).attrs["caption"]
    seed = frame["training_seed"].isna() | (frame["training_seed"] == frame["training_seed"].min())
    one = headline(summary(frame[seed & (frame["profile_id"] == 0)])).attrs["caption"]
    assert "saved: against" in one
    assert "interval" not in one
