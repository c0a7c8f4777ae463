"""Numbers of the pages, recomputed from the rows in outputs/reference without the package."""

from __future__ import annotations

import json
import re
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from page_blocks import ROOT
from scipy.stats import t as student

from lcc_rl.functional.power import POWER_COEFFICIENTS

REFERENCE = ROOT / "outputs" / "reference"
PATH, FLOW, FUEL = "total_path_energy_kj", "flow_vph", 42.4  # kJ per g of petrol
BOTH = "[cav_energy,hdv_energy]"
PETROL, VARIANTS = "total_second_path_energy_kj", ("alcc", "own_energy")


def means(file: str, *columns: str, by: str = "strategy", **where: object) -> pd.DataFrame:
    """Means over the windows of the rows with these values; ``e``: energy per m or km."""
    rows = pd.read_parquet(REFERENCE / f"{file}.parquet")
    for name, value in where.items():
        rows = rows[rows[name] == value]
    found = rows.groupby(by)[list(columns)].mean()
    return found.assign(e=found[columns[0]] / found[columns[1]] if len(columns) > 1 else np.nan)


def equal_flow(rows: pd.DataFrame, own: str, other: str, energy: str = "e") -> float:
    """Saving at the recorded flow, or at the least one that both kinds of strategies have."""

    def front(kind: str) -> tuple[pd.Series, pd.Series]:
        part = rows[rows.index.str.fullmatch(rf"{kind}( X=.*)?")].sort_values(FLOW)
        return part[FLOW], part[energy]

    mine, others = front(own), front(other)
    flow = max(rows.loc["recorded", FLOW], mine[0].min(), others[0].min())
    return float(1.0 - np.interp(flow, *mine) / np.interp(flow, *others))


def flow_bounds(name: str) -> tuple[float, float]:
    """95 % interval of a strategy's flow against the recorded one [%]: jackknife over drives."""
    rows = pd.read_parquet(REFERENCE / "main.parquet").set_index("drive")
    mean = rows.groupby("strategy")[FLOW].mean()
    without = (rows.drop(drive).groupby("strategy")[FLOW].mean() for drive in {*rows.index})
    shares = np.array([100.0 * (x[name] / x["recorded"] - 1.0) for x in without])
    half = student.ppf(0.975, len(shares) - 1) * np.sqrt(shares.var() * (len(shares) - 1))
    value = 100.0 * (mean[name] / mean["recorded"] - 1.0)
    return value - half, value + half


def readme() -> list[str]:
    rows = means("main", PATH, "distance_m", FLOW, PETROL)
    rows["petrol"] = rows[PETROL] / rows["distance_m"]
    found = []
    for name in ("human", "rule", "reference", "alcc"):
        energy, flow = (rows[x][name] / rows[x]["recorded"] - 1.0 for x in ("e", FLOW))
        low, high = flow_bounds(name)
        found += [f"| {-energy:.1%} (", f"| {flow:+.0%} ({low:.0f} … {high:.0f}) |"]
    for name in ("rule", "reference", "alcc"):
        kinds = ("e", "petrol")
        found += [f"| {equal_flow(rows, name, 'recorded', x):.1%} (" for x in kinds]
    found += [f"| {equal_flow(rows, name, 'rule'):.1%} (" for name in ("reference", "alcc")]
    rows = means("main_electric", PETROL, "distance_m", FLOW)
    rule, *networks = (
        100.0 * equal_flow(rows, x, "recorded") for x in ("rule", "reference", "alcc")
    )
    found += [f"saves {rule:.1f}, {networks[0]:.1f} and {networks[1]:.1f}%"]
    i80 = means("averaged", PATH, "distance_m", FLOW, source="i80")
    return [
        *found,
        *findings(),
        f"network needs {equal_flow(i80, 'alcc', 'idm_acc_filtered'):.1%} (",
    ]


def findings() -> list[str]:
    """Numbers of README's section on what was found, and of its figure."""
    driven = pd.read_parquet(REFERENCE / "twins.parquet").groupby("driver").sum(numeric_only=True)
    energy = driven["energy_1.1s_j"] / driven["distance_1.1s_m"]
    net, columns = "total_net_energy_kj", ["variant", "limit"]
    fleets = pd.read_parquet(REFERENCE / "tasks" / "fleets_fronts.parquet")
    fleets = fleets[fleets["setting"] == "drives_traffic"]
    fleets = fleets.groupby(columns)[[net, "distance_m", FLOW]].mean().reset_index(level=1)
    fleets["e"] = fleets[net] / fleets["distance_m"]
    rule, (own, humans) = (
        fleets.loc[["ahead"]].sort_values(FLOW),
        (fleets.loc[[x]].mean() for x in ("learned", "human")),
    )
    at_its_flow = np.interp(own[FLOW], rule[FLOW], rule["e"])
    regard = pd.read_parquet(REFERENCE / "limits_true_drivers.parquet")
    regard["way"] = regard["cav_distance_m"] + regard["hdv_distance_m"]
    gaps = "share_time_gap_long_moving"
    means = regard.groupby(["policy", "variant", "limit"])[[gaps, PATH, "way"]].mean()
    means["e"] = means[PATH] / means["way"]
    both, either = (
        [
            float(np.interp(0.0115, *means.loc[drivers, kind][[gaps, "e"]].to_numpy().T))
            for drivers in ("i80", "i80_energy")
        ]
        for kind in VARIANTS
    )
    least, most = (1.0 - x / y for x, y in zip(both, either, strict=True))
    rings = pd.read_parquet(REFERENCE / "tasks" / "ring_reactions.parquet")
    late = rings[(rings["delay_s"] == 0.5) & (rings["strategy"] == "pretrained")]["damping_time_s"]
    return [
        f"use {1.0 - energy['as calibrated'] / energy['recorded']:.0%} less",
        f"save {1.0 - own['e'] / humans['e']:.1%} (",
        f"at {1.0 - own[FLOW] / humans[FLOW]:.1%} less flow",
        f"less flow, {1.0 - own['e'] / at_its_flow:.1%} (",
        f"driver behind saves {100.0 * least:.1f} to {most:.1%} in windows",
        f"ends {late.count()} of {len(late)} waves",
    ]


def limits() -> list[str]:
    rows = means("limits_steady", PATH, "distance_m", FLOW, drivers="i80", episodes=60)
    own, recorded = rows.loc["alcc alcc_limits"], rows.loc["recorded"]
    flow = own[FLOW] / recorded[FLOW] - 1.0
    return [f"| {1e3 * own['e']:.0f}, {1.0 - own['e'] / recorded['e']:.1%} (", f"| {flow:+.0%} |"]


def at_equal_flow() -> list[str]:
    rows = means("averaged", PATH, "distance_m", FLOW, source="stop_and_go")
    return [f"network against tuned IDM | {equal_flow(rows, 'alcc', 'idm_acc_filtered'):.1%}"]


def trainings() -> list[str]:
    rows, rule = means("limits_trainings", PATH, "distance_m", FLOW), "idm_acc_filtered"
    one, three = (
        sorted(100.0 * equal_flow(rows, f"{limit}_{seed}", rule) for seed in range(3))
        for limit in ("one", "three")
    )
    return [f"need {one[0]:.1f} to {one[2]:.1f}% less", f"below {three[0]:.1f} to {three[2]:.1f}%"]


def bounds() -> list[str]:
    found = []
    for source in ("platoons", "stop_and_go"):
        rows = means("bounds_at_flow", PATH, "distance_m", FLOW, source=source)
        found.append(f"needs {equal_flow(rows, 'clairvoyant', 'alcc'):.1%} (")
    return found


def alcc() -> list[str]:
    drawn = means("alcc/evaluation/windows", "total_energy_kj")["total_energy_kj"]
    of_page = (ROOT / "docs" / "alcc.md").read_text(encoding="utf-8").replace("\n", " ")
    assert f"({POWER_COEFFICIENTS[0][2]:.0f} + {POWER_COEFFICIENTS[1][2]} v) a²" in of_page
    return [f"| this study | 8 | {100.0 * (1.0 - drawn['alcc'] / drawn['reference']):.2f} ("]


def hcfs() -> list[str]:
    return [
        f"| I-80 | HCFS | {means('hcfs/sources', 'reward', source='traffic').reward['hcfs']:.2f} ("
    ]


def waves() -> list[str]:
    columns = ("energy_kj_per_km", "mean_speed_mps")
    rows = means("tasks/ring_reactions", *columns, delay_s=0.4, noise_mps2=0.4)
    fuel, speed = rows[columns[0]] / FUEL, rows[columns[1]]
    found = ("human", "drawn_reactions", "calm")
    return [f"{speed[x]:.2f} m/s, {fuel[x]:.0f} g/km" for x in found]


def tasks() -> list[str]:
    columns = ("all_net_energy_kj", "distance_m", FLOW)
    found = []
    for task, windows in (("i24-follow5", 100), ("i24-mixed", 100), ("i24-mixed", 400)):
        rows = means("tasks/warm_up", *columns, task=task, horizon_s=windows, warm_up_s=20.0)
        humans = rows.loc["human"]
        saved, flow = (1.0 - rows[x]["alcc"] / humans[x] for x in ("e", FLOW))
        flow = -flow
        found += [f"| {saved:.1%} (", f"| {flow:.1%} |" if flow > -0.01 else f"| {flow:.0%} |"]
        if task == "i24-follow5":
            found += [f"saves {saved:.1%} (", f"from {humans[FLOW]:,.0f}"]
        elif windows == 100:
            kept = pd.read_parquet(REFERENCE / "tasks" / "i24-mixed.parquet").set_index("strategy")
            assert kept.loc["alcc", "saving"] == pytest.approx(saved, abs=1e-6)
    return found


def fleets() -> list[str]:
    columns = ("total_net_energy_kj", "distance_m", FLOW)
    rows = means("tasks/fleets_fronts", *columns, by="variant", setting="drives_taught")
    own, humans = rows.loc["learned"], rows.loc["human"]
    flow = f"{own[FLOW]:,.0f}: {own[FLOW] / humans[FLOW] - 1.0:.1%} ("
    return [f"trained over 400 s | 4% | {1.0 - own['e'] / humans['e']:.1%} (", flow]


def road() -> list[str]:
    columns = ("fuel_l_per_100km", FLOW)
    own = means("road", *columns, automated_pct=10.0, leaders="platoons").loc["network"]
    return [f"network | {own[columns[0]]:.2f} (", f"| {own[FLOW]:,.0f} ("]


def everyday() -> list[str]:
    rows = pd.read_parquet(REFERENCE / "road.parquet")
    rows = rows[rows["leaders"] == "everyday"].set_index("strategy")
    crashed, found = rows[rows["collisions"] > 0], []
    assert crashed[["fuel_saved_pct", FLOW]].isna().all(axis=None)
    for name in ("idm_acc", "network"):
        fuel, flow = (rows[x][name] / rows[x]["human"] - 1.0 for x in ("fuel_l_per_100km", FLOW))
        found += [f"| {-fuel:.1%} (", f"| {flow:.1%} ("]
    return [*found, *(f"| {x} windows |" for x in crashed["collisions"])]


def leaderboard() -> list[str]:
    stored = json.loads((REFERENCE / "scores" / "idm_acc.json").read_text(encoding="utf-8"))
    row = next(
        x for x in stored["results"] if (x["task"], x["source"]) == ("i24-fleet", "everyday")
    )
    saved = 100.0 * (1.0 - row["score"] / row["baseline"])
    return [
        f"| `idm_acc` | +{saved:.1f} (",
        f"| {row['flow_vph']:,.0f} | {-100.0 * row['flow_lost']:+.1f} |",
    ]


def ablations() -> list[str]:
    acts = "share_filter_acts"
    rows = means("ablations", PATH, "distance_m", FLOW, acts)
    full, *others = (
        f"alcc reward.without={terms}"
        for terms in ("null", "safety", "efficiency", "cav_energy", "hdv_energy", BOTH)
    )
    more = {one: rows[FLOW][one] / rows[FLOW][full] - 1.0 for one in others}
    found = [f"at {-more[others[1]]:.1%} (", f"at {more[others[-1]]:.1%} ("]
    found.append(f"at {rows[FLOW][others[-1]] / rows[FLOW]['recorded'] - 1.0:.1%} more flow")
    for one in others[:-1]:
        at_flow = (equal_flow(rows, re.escape(one), x) for x in ("recorded", re.escape(full)))
        cells = [1.0 - rows["e"][one] / rows["e"][full], *at_flow]
        found += [f"| {100.0 * cell:.2f} (" for cell in cells]
    held = 100.0 * rows[acts][[f"{one} X=1.7" for one in (full, *others)]]
    found.append(f"in {held[:-1].min():.0f} to {held[:-1].max():.0f}%")
    return [*found, f"in {held.iloc[-1]:.0f}%"]


PAGES: dict[str, tuple[Callable[[], list[str]], str]] = {
    "README": (readme, ""),
    "limits, bounds": (bounds, ""),
    "limits": (limits, "| network, `pretrained/alcc_limits` | 528,"),
    "limits, equal flow": (at_equal_flow, "| OpenACC, test track and low speed"),
    "limits, trainings": (trainings, ""),
    "ablations": (ablations, ""),
    "alcc": (alcc, "| this study |"),
    "hcfs": (hcfs, "| I-80 | HCFS |"),
    "waves": (waves, "| 0.4 s, noise 0.4 m/s² |"),
    "tasks": (tasks, ""),
    "fleets": (fleets, "| I-24, whole drives, trained over 400 s |"),
    "road": (road, "| | network | 7.04"),
    "road, everyday": (everyday, ""),
    "leaderboard": (leaderboard, "| everyday, 9 drives | `idm_acc`"),
}


@pytest.mark.parametrize("name", PAGES)
def test_a_row_of_the_page_is_that_of_the_kept_rows(name: str) -> None:
    compute, begins = PAGES[name]
    folder = ROOT if name == "README" else ROOT / "docs"
    page = (folder / f"{name.split(',')[0]}.md").read_text(encoding="utf-8")
    rows = " ".join(line for line in page.splitlines() if line.startswith(begins))
    for words in compute():
        found = words.replace(" -", " −").replace("(-", "(−").replace("%", " %").replace("+-", "−")
        assert found in rows.replace("**", ""), found
