"""The page: escaped, self-contained, numbers with units and intervals; the main job's headline."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from io import BytesIO

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from rich.console import Console
from study_frames import episodes

from lcc_rl.api import Run
from lcc_rl.config import load
from lcc_rl.errors import ConfigError
from lcc_rl.figures.drawing import new_figure, save
from lcc_rl.figures.page import section, write_sections
from lcc_rl.io.files import processor, read_parquet, write_parquet
from lcc_rl.results.measures import WAYS, heading
from lcc_rl.results.names import in_words, worded
from lcc_rl.results.render import as_markdown, terminal
from lcc_rl.results.report import Report, report, windows_for
from lcc_rl.results.windows import Means, savings
from lcc_rl.studies.study import StudyResults

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
    folder = tmp_path_factory.mktemp("page")
    write_parquet(pd.DataFrame({"a": [1]}), folder / "run" / "training.parquet")
    drawn, text = save(figure, folder / "line.png"), "One < two.\n\nNext."
    made = section("First & last", text, [("A table", TABLE)], [("A line", drawn)])
    return write_sections(folder, "A job", [made], ["lcc-rl run"])


def test_a_page_holds_everything_and_fetches_nothing(page) -> None:
    html = page.read_text()
    links = re.findall(r'(?:src|href|action)="([^"]*)"', html)
    assert all(link.startswith(("#", "data:image/")) for link in links)
    assert not re.search(r"<script|<link|url\(|@import|https?://", html)
    assert "default-src 'none'" in html
    assert html.count("<table>") == 2
    assert html.count("<details>") == 1
    for words in ("First &amp; last", "One &lt; two.</p>", "lcc-rl run", "<td>torch</td>"):
        assert words in html
    assert f"Its trainings ran on: {processor()} (1)." in html


def test_cells_are_formatted_for_readers(page) -> None:
    html = page.read_text()
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
    html = page.read_text()
    (data,) = re.findall(r"data:image/webp;base64,([^\"]+)", html)
    shown = Image.open(BytesIO(base64.b64decode(data))).convert("RGBA")
    assert shown.tobytes() == Image.open(page.with_name("line.png")).convert("RGBA").tobytes()


def test_a_study_writes_files_and_fills_marked_tables(tmp_path) -> None:
    figure = new_figure(2.0, 1.0)
    made = StudyResults(tmp_path, ["svg"])
    made.table("energies", "A table", TABLE)
    made.figure("line", "A line", figure)
    assert (tmp_path / "figures" / "line.svg").exists()
    pd.testing.assert_frame_equal(read_parquet(tmp_path / "tables" / "energies.parquet"), TABLE)
    made.write("A study")
    text = (tmp_path / "results.md").read_text()
    assert "![A line](figures/line.png)" in text
    assert as_markdown(worded(TABLE)) in text


def test_the_headline_is_the_summary_and_those_that_draw_most_stand_first() -> None:
    found = report(windows_for(episodes()))
    table = found.short
    cars = found.table.set_index("strategy").loc[table["strategy"]]
    assert list(table["strategy"]) == ["idm", "alcc", "reference"]
    np.testing.assert_array_equal(table["energy_kj_per_km"], cars["path_energy_kj_per_km"])
    # Falling behind gains nothing: alcc drives 290 m, the others 300 m.
    per_km = cars["total_path_energy_kj"] / np.array([0.3, 0.29, 0.3])
    np.testing.assert_allclose(table["energy_kj_per_km"], per_km)
    saved = 1.0 - per_km["alcc"] / per_km["idm"]
    assert cars.loc["alcc", "saving"] == pytest.approx(saved)
    means = Means.of(episodes()).per_km()  # of the figures by driver
    shown = means.saving("total_path_energy_kj", "alcc", "idm")
    assert shown.value == pytest.approx(saved)
    by_driver = means.drivers.groupby("strategy")["total_path_energy_kj"].mean()
    np.testing.assert_allclose(by_driver[table["strategy"]], per_km)
    assert found.verdict == ""  # nobody to compare with
    assert found.against == "idm"
    assert table["saved_pct"].tolist()[1] == pytest.approx(100.0 * saved)
    assert table["distance_pct"].tolist() == pytest.approx([0.0, -100.0 / 30.0, 0.0])


def test_humans_alone_have_a_row_and_none_beside_controlled_cars() -> None:
    humans = episodes()[lambda rows: rows["strategy"] == "direct"].assign(cav_distance_m=np.nan)
    (row,) = report(windows_for(humans)).short.to_dict("records")
    assert row["driver"] == "no automated car"
    assert row["energy_kj_per_km"] == pytest.approx(humans["hdv_path_energy_kj"].mean() / 0.15)
    assert "direct" not in report(windows_for(episodes())).short["strategy"].tolist()


def test_every_table_of_strategies_fits_80_columns() -> None:
    rows = episodes(profiles=8).replace({"strategy": {"idm": "human"}})
    found = report(windows_for(rows))
    ends = {"saved_pct": -9.3, "saved_pct_low": -10.8, "saved_pct_high": -8.1}
    console = Console(width=200)
    with console.capture() as shown:
        one = replace(found, short=found.short.assign(**ends), verdict="")
        console.print(terminal(one, "title [x]"))
    lines = shown.get().splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 80
    assert "title [x]" in lines[0]
    assert "−9.3 (−10.8 … −8.1)" in shown.get()
    assert "saved: against simulated drivers" in " ".join(shown.get().split())
    assert "nan" not in shown.get()


def test_names_are_words_in_tables_and_figures() -> None:
    words = {
        "alcc": "network",
        "alcc analytic": "network (analytic)",
        "idm_acc": "tuned IDM",
        "my_pid_filtered": "my_pid, filtered",
        "idm 1.1": "idm 1.1",
    }
    assert {name: in_words(name) for name in words} == words


def said(frame: pd.DataFrame) -> Report:
    return report(windows_for(frame), few=True)


def test_the_verdict_says_what_came_out_and_how_sure_it_is() -> None:
    frame = episodes(profiles=12).replace({"strategy": {"idm": "rule", "reference": "human"}})
    frame["total_path_energy_kj"] += np.random.default_rng(0).normal(size=len(frame))
    found = said(frame)
    cars = found.table.set_index("strategy")["path_energy_kj_per_km"]
    saved = 100.0 * (1.0 - cars["alcc"] / cars["rule"])
    words = found.verdict
    assert words.startswith(f"With the network, energy per vehicle and km is {saved:.1f} % (")
    assert ") less than with IDM, tuned on these data, within the uncertainty; long time" in words
    far = frame.copy()  # far less than with the rule
    far.loc[far["strategy"] == "alcc", "total_path_energy_kj"] *= 0.1
    assert ") less than with IDM, tuned on these data; long time gaps: 0.40 %" in said(far).verdict
    # So has a network of any name, and each of several.
    frame.loc[frame["strategy"] == "human", "training_seed"] = np.nan
    both = [frame.replace({"strategy": {"alcc": name}}) for name in ("near", "far")]
    found = said(pd.concat(both).drop_duplicates())
    first, second, least = found.verdict.splitlines()
    most = found.short.iloc[-1]
    assert least == f"Least energy: {most['driver']}, {most['energy_kj_per_km']:,.1f} kJ/km."
    assert first == words.splitlines()[0].replace("the network", "near", 1)
    assert second.startswith("With far, energy")
    # A network that collides is not compared, and a rule that does is no baseline.
    hit = frame["profile_id"] == 0
    crashed = said(frame.assign(collided=hit & (frame["strategy"] == "alcc")))
    assert "With" not in crashed.verdict
    assert "network" in crashed.note
    crashed = said(frame.assign(collided=hit & (frame["strategy"] == "rule")))
    assert "than with simulated drivers" in crashed.verdict.splitlines()[0]
    few = said(frame[frame["profile_id"] < 4]).verdict
    assert few.endswith("; 4 windows are too few for a conclusion.")
    assert "%" not in few


def test_flow_stands_against_the_recorded_drivers_in_table_and_verdict() -> None:
    frame = episodes(profiles=12).replace({"strategy": {"idm": "rule", "reference": "human"}})
    flows = {"alcc": 1900.0, "rule": 1800.0, "human": 2100.0, "direct": 2000.0}
    frame["flow_vph"] = frame["strategy"].map(flows)
    found = said(frame)
    assert "flow against simulated drivers" in found.caption
    assert found.verdict.splitlines()[0].endswith("; flow: 1,900 vehicles per hour against 1,800.")
    people = frame[frame["strategy"] == "human"].assign(strategy="recorded", flow_vph=2000.0)
    found = said(pd.concat([frame, people]))
    shares = found.short.set_index("strategy")["flow_pct"].to_dict()
    expected = {"alcc": -5.0, "rule": -10.0, "human": 5.0, "recorded": 0.0}
    assert shares == pytest.approx(expected)
    assert "flow against the recorded drivers" in found.caption
    assert found.verdict.splitlines()[0].endswith(" 1,800, the recorded drivers 2,000.")


def test_the_table_of_an_evaluation_ends_with_the_verdict(tmp_path) -> None:
    cfg = load("evaluate", ["variant=alcc"])
    frame = episodes(profiles=12).replace({"strategy": {"idm": "rule", "reference": "human"}})
    run = Run(tmp_path, frame, cfg)
    assert " less than with IDM, tuned on these data" in " ".join(run.printed().split())
    few = Run(tmp_path, frame[frame["profile_id"] < 4], cfg)
    assert "too few for a conclusion" not in few.printed()


def test_one_strategy_is_compared_with_nobody_and_one_window_has_no_interval() -> None:
    frame = episodes(profiles=12)
    alone = report(windows_for(frame[frame["strategy"] == "idm"]))
    assert alone.against is None
    assert not {"saved_pct", "distance_pct"} & set(alone.short)
    assert "saved" not in alone.caption
    assert "with the 95 % interval" in report(windows_for(frame)).caption
    seed = frame["training_seed"].isna() | (frame["training_seed"] == frame["training_seed"].min())
    one = report(windows_for(frame[seed & (frame["profile_id"] == 0)])).caption
    assert "saved: against" in one
    assert "interval" not in one


def test_savings_are_against_the_strategy_that_is_asked_for() -> None:
    windows = windows_for(episodes(profiles=12))
    found = report(windows, against="reference")
    alcc = found.table.set_index("strategy").loc["alcc"]
    assert alcc["against"] == found.against == "reference"
    expected = savings(windows, "total_path_energy_kj", "alcc", "reference", WAYS)
    assert (alcc["saving"], alcc["saving_low"]) == pytest.approx((expected.value, expected.low))
    with pytest.raises(ConfigError, match="Did you mean 'reference'"):
        report(windows, against="referenc")
