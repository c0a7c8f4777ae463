"""Tables of small evaluations as commands print them, letter by letter, beside what is kept.

``LCC_RL_RECORD=1 pytest tests/results/test_rendered.py`` records them anew; a commit that does so
gives the reason.
"""

from __future__ import annotations

import os
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from helpers import check_refused
from study_frames import episodes

from lcc_rl.cli import table
from lcc_rl.commands import evaluation
from lcc_rl.commands.evaluation import reports
from lcc_rl.config import load
from lcc_rl.io.files import write_parquet
from lcc_rl.results.report import Report
from lcc_rl.results.runs import EPISODES, save_config

KEPT = Path(__file__).parent / "rendered"
RECORD = bool(os.environ.get("LCC_RL_RECORD"))
SETTINGS = {
    "episodes": ["variant=alcc"],
    "sources": ["variant=alcc"],
    "task": ["task=i80-follow"],
    "ring": ["task=ring-22"],
    "platoons": ["variant=cacc"],
}
FORMS = {
    "text": (),
    "all": ("--all",),
    "markdown": ("--format", "markdown"),
    "latex": ("--format", "latex"),
    "csv": ("--format", "csv"),
}


def noisy() -> pd.DataFrame:
    """Rows of strategies on twelve windows of six drives, no two alike."""
    frame = episodes(profiles=12).replace({"strategy": {"idm": "human", "reference": "rule"}})
    generator = np.random.default_rng(0)
    frame["drive"] = "drive " + (frame["profile_id"] // 2).astype(str)
    for name in frame.columns[frame.columns.str.endswith("_kj")]:
        frame[name] += generator.normal(size=len(frame))
    for group in ("cav", "hdv", "total"):
        frame[f"{group}_net_energy_kj"] = frame[f"{group}_path_energy_kj"] + 5.0
    frame["share_leader_faster"] = generator.uniform(0.0, 0.3, len(frame))
    frame["cav_share_infeasible"], frame["hdv_share_infeasible"] = 0.02, 0.001
    return frame


def ring() -> pd.DataFrame:
    """The same of a ring: with traffic and damping times, of some episodes none."""
    frame, generator = noisy(), np.random.default_rng(1)
    order = np.arange(len(frame))
    frame["flow_vph"] = generator.normal(2000.0, 20.0, len(frame))
    frame.loc[frame["strategy"] == "rule", "flow_vph"] *= 0.9
    frame["damping_time_s"] = np.where(order % 3, np.nan, frame["flow_vph"] / 30.0)
    for name in ("mean_gap_m", "mean_speed_mps", "final_speed_spread_mps", "speed_std_mps"):
        frame[name] = generator.uniform(1.0, 2.0, len(frame))
    return frame.assign(max_gap_m=30.0 + order % 7, max_time_gap_s=3.0, min_time_gap_s=1.0)


def platoons() -> pd.DataFrame:
    """Rows of three followers of two strategies in two cases."""
    generator = np.random.default_rng(2)
    names = ["strategy", "training_seed", "case", "run_id"]
    runs = [("cacc tuned", None), ("hcfs", 0), ("hcfs", 1)]
    keys = [
        (*one, case, run) for one in runs for case in ("case 1", "windows") for run in (0, 1, 2)
    ]
    frame = pd.DataFrame([key for key in keys for _ in range(3)], columns=names)
    frame = frame.astype({"training_seed": "Int64"}).assign(profile="w", frames=100, collided=False)
    learned = frame["strategy"] == "hcfs"
    for name in ("speed_error", "jerk"):
        size = generator.uniform(10.0, 20.0, len(frame))
        frame[f"{name}_sum"], frame[f"{name}_squares"] = size, size**2 / 50.0
    frame["reward"] = -generator.uniform(1.0, 2.0, len(frame))
    for name in ("min_gap_m", "max_gap_error_m", "peak_jerk_mps3", "energy_ratio"):
        frame[name] = generator.uniform(0.5, 1.5, len(frame))
    frame["learned_share"] = np.where(learned, generator.uniform(size=len(frame)), np.nan)
    counts = generator.integers(0, 5, (3, len(frame)))
    return frame.assign(switches=counts[0], clamps=counts[1], cap_interventions=counts[2])


def sources() -> pd.DataFrame:
    frame = noisy()
    return frame.assign(source=np.where(frame["profile_id"] < 6, "stream", "highway"))


ROWS = {
    "episodes": noisy,
    "sources": sources,
    "task": lambda: ring().drop(columns=["damping_time_s", "flow_vph"]),
    "ring": ring,
    "platoons": platoons,
}


@pytest.mark.parametrize("name", ROWS)
def test_tables_are_printed_as_kept(name: str, tmp_path: Path, capsys, monkeypatch) -> None:
    made: list[Report] = []  # the same for every form
    monkeypatch.setattr(evaluation, "reports", lambda *x: made or made.extend(reports(*x)) or made)
    cfg = load("evaluate", SETTINGS[name])
    save_config(cfg, tmp_path)
    write_parquet(ROWS[name](), tmp_path / EPISODES)
    if name == "platoons":
        table.main([str(tmp_path), "--format", "latex", "--columns", "driver,reward"])
        assert "\ncase 1 & CACC, tuned & " in capsys.readouterr().out
    for form, words in FORMS.items():
        table.main([str(tmp_path), *words])
        printed, file = capsys.readouterr().out, KEPT / f"{name}.{form}.txt"
        if RECORD:
            KEPT.mkdir(exist_ok=True)
            file.write_text(printed, encoding="utf-8")
        if form == "csv":  # numbers of all digits
            found, kept = pd.read_csv(StringIO(printed)), pd.read_csv(file)
            pd.testing.assert_frame_equal(found, kept, rtol=1e-9)
            table.main([str(tmp_path), *words, "--decimal", "comma"])
            comma = pd.read_csv(StringIO(capsys.readouterr().out), sep=";", decimal=",")
            pd.testing.assert_frame_equal(comma, kept, rtol=1e-9)
        else:
            assert printed == file.read_text(encoding="utf-8"), f"{name}, {form}"


def test_energies_come_in_the_unit_asked_for(tmp_path, capsys) -> None:
    for name in ("episodes", "task", "ring", "platoons"):
        save_config(load("evaluate", SETTINGS[name]), tmp_path / name)
        write_parquet(ROWS[name](), tmp_path / name / EPISODES)

    def shown(name: str, *words: str) -> pd.DataFrame:
        table.main([str(tmp_path / name), "--format", "csv", *words])
        return pd.read_csv(StringIO(capsys.readouterr().out))

    for name, before, after in (
        ("episodes", "energy_kj_per_km", "energy_kwh_per_100km"),
        ("task", "score", "score"),
    ):
        asked, short = shown(name, "--unit", "kWh/100km"), shown(name)
        np.testing.assert_allclose(asked[after], short[before] / 36.0)
        every = shown(name, "--all", "--unit", "kWh/100km").set_index("strategy")
        first = shown(name, "--all").set_index("strategy").filter(regex=f"^{before}(_|$)")
        np.testing.assert_allclose(every.filter(regex=f"^{after}(_|$)"), first / 36.0)
        assert first.notna().all(axis=None) & (first.shape[1] == 3)
        assert every.filter(like="rms_jerk").notna().all(axis=None)  # with its interval
        every = every.loc[asked["strategy"], [*asked][1:]]  # all that the short table has
        pd.testing.assert_frame_equal(every, asked.set_index("strategy"), check_dtype=False)
        table.main([str(tmp_path / name), "--all", "--unit", "kWh/100km"])
        assert "[kWh/100km]" in capsys.readouterr().out
    petrol = noisy().assign(all_fuel_l=lambda rows: rows["total_path_energy_kj"] / 3e4)
    for unit in ("g/km", "L/100km", "mpg"):  # each beside the litres drawn
        words = [*SETTINGS["episodes"], "energy=fuel", f"unit={unit}"]
        (made,) = reports(petrol, load("evaluate", words))
        assert made.table.columns.is_unique
        assert made.short[made.score].notna().all()
    (made,) = reports(noisy(), load("evaluate", [*SETTINGS["episodes"], "unit=Wh/km"]))
    assert made.score in {*made.short} & {"energy_wh_per_km"}
    cases = [
        ("episodes", "mpg", r"unit=mpg \(task.unit, --unit\) needs vehicles that all burn one"),
        ("ring", "Wh/km", "the score of this task is no energy per distance"),
        ("platoons", "Wh/km", "tables of platoons have no energy per distance"),
    ]
    check_refused(lambda name, unit: shown(name, "--unit", unit), cases)
