"""Figures of evaluations (ALCC Figs. 7, 9 and 10)."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import fill, shorten
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from pandas.api.types import is_numeric_dtype

from lcc_rl.config.words import FILTERED
from lcc_rl.figures.drawing import (
    COLUMN_WIDTH,
    INK,
    PAGE_WIDTH,
    SOFT,
    colour,
    dots,
    in_file,
    legend_above,
    lines_of,
    new_figure,
    paper,
    rows_of,
    save,
)
from lcc_rl.figures.platoon import platoon_figures
from lcc_rl.figures.space_time import space_time
from lcc_rl.io.files import read_parquet
from lcc_rl.results.intervals import Estimate, share_saved
from lcc_rl.results.measures import between, signed
from lcc_rl.results.motion import most_varied, of_first_seed
from lcc_rl.results.names import ON_FRONT, RULE, in_words, several, size_of
from lcc_rl.results.render import column_cells
from lcc_rl.results.report import AGAINST, ALL, COLLISIONS, COUNTS, Report
from lcc_rl.results.runs import CONFIG, EPISODES, STEPS, read_settings
from lcc_rl.results.windows import Means, by_driver, varied_in

LINES = "{}; lines: 95 % intervals"  # of a figure, after its numbers of windows and drivers
VEHICLE_STYLES = {
    "leader": ("leader", INK),
    "cav": ("controlled car", "#0072b2"),
    "hdv": ("human behind", "#d55e00"),
}


def write_figures(
    folder: str | Path,
    rows: str = "episodes",
    reports: Sequence[Report] = (),
    own: Collection[str] = (),
) -> None:
    """Draw the figures of an evaluation into its folder ``figures``.

    Args:
        folder: folder with config.yaml, episodes.parquet and steps.parquet.
        rows: subject of a row of episodes.parquet, ``episodes`` or ``vehicles``.
        reports: reports of the evaluation; ``overview`` shows the savings of a single one.
        own: strategies that are the user's controllers.

    Raises:
        ResultsError: if a table is missing or a figure cannot be written.
    """
    folder = Path(folder)
    steps, cfg = read_parquet(folder / STEPS), read_settings(folder / CONFIG)
    found: Iterable[tuple[str, Figure]]
    if rows == "episodes":
        found = study_figures(read_parquet(folder / EPISODES), steps, cfg, reports, own)
    else:
        bound = float((cfg.get("deployed") or {}).get("jerk_bound", 30.0))
        found = platoon_figures(steps, bound)
    formats = cfg.get("figure_formats", ())
    drawn: set[str] = set()  # case-folded names, for file systems that ignore case
    for stem, figure in found:
        file = in_file(stem)
        while file.casefold() in drawn:
            file += "_"
        drawn.add(file.casefold())
        save(figure, folder / "figures" / f"{file}.png", formats=formats)


def study_figures(
    episodes: pd.DataFrame,
    steps: pd.DataFrame,
    cfg: Mapping[str, Any],
    reports: Sequence[Report] = (),
    own: Collection[str] = (),
) -> Iterator[tuple[str, Figure]]:
    """Yield name and figure for an evaluation with a row per episode.

    Only networks and the user's controllers get separate figures.

    Args:
        episodes: rows of episodes.parquet.
        steps: rows of steps.parquet; it may have none.
        cfg: the evaluation's configuration.
        reports, own: as for :func:`write_figures`.
    """
    episodes = episodes[~episodes["strategy"].str.contains(ON_FRONT)]
    means, names = Means.of(episodes).per_km(), list(dict.fromkeys(episodes["strategy"]))
    many = episodes["driver_id"].nunique() > 2
    # One that collides in all its episodes before the counted time has nothing to show.
    known = episodes.filter(regex="^(cav|hdv)_path_energy_kj$").notna().any(axis=1)
    measured = {*episodes.loc[known, "strategy"]}
    cars = [name for name in names if name != "direct" and name in measured]
    seeds = episodes.groupby("strategy")["training_seed"].count()
    shown = [name for name in cars if name != RULE and (seeds[name] or name in own)]
    # Human drivers, networks, the user's controllers, others; filtered strategies last.
    order = sorted(
        names, key=lambda x: (x != "human", not seeds[x], x not in shown, x.endswith(FILTERED))
    )
    diagram = space_time(steps, order, cfg) if len(steps) else None
    if diagram is not None:
        yield "space_time", diagram
    # Those of the episode that is drawn; one may have collided there before the counted time.
    sampled = {*most_varied(steps)["strategy"]} if len(steps) else set()
    seen = [name for name in shown or cars if name in sampled]
    if seen and len(reports) == 1 and "saved_pct" in reports[0].short:
        yield "overview", overview(episodes, steps, seen[-1], reports[0])
    for name in shown:
        if name in sampled:
            yield f"episode {name}", sample_episode(steps, name)
        if "direct" in names:
            yield f"human_energy {name}", human_energy_figure(means, name)
        # After a collision the rest of an episode is not driven, which is no saving.
        whole = not episodes.loc[episodes["strategy"] == name, "collided"].any()
        for baseline in AGAINST if many and whole else ():
            if baseline in measured and baseline != name:
                figure = paired_improvement(means, name, baseline)
                yield f"improvement {name} vs {baseline}", figure


@paper
def sample_episode(steps: pd.DataFrame, strategy: str) -> Figure:
    """Speeds, accelerations and gaps of one held-out episode (Fig. 7)."""
    rows = _one_episode(steps, strategy)
    first = rows.iloc[0]
    figure = new_figure(COLUMN_WIDTH, 4.4)
    axes = figure.subplots(3, 1, sharex=True)
    for axis, entry in zip(axes, ("speed", "acceleration", "gap"), strict=True):
        _over_time(axis, rows, entry)
    axes[0].set(ylabel="speed [m/s]")
    axes[1].set(ylabel="acceleration [m/s²]")
    axes[2].set(xlabel="time [s]", ylabel="gap ahead [m]")
    legend_above(axes[0])
    title, own = fill(in_words(strategy), 45), first[["desired_speed_mps", "time_gap_s"]]
    if own.notna().all():
        title += "\nhuman behind: desired speed {:.1f} m/s, time gap {:.2f} s".format(*own)
    figure.suptitle(title)
    return figure


@paper
def overview(episodes: pd.DataFrame, steps: pd.DataFrame, strategy: str, report: Report) -> Figure:
    """Speeds of one episode, and the saving of each strategy of a report."""
    table = report.short
    lines = max(len(lines_of(str(name)).splitlines()) for name in table["strategy"])
    figure = new_figure(PAGE_WIDTH, max(2.7, 0.9 + 0.13 * lines * len(table)))
    left, right = figure.subplots(1, 2, width_ratios=(4, 5))
    _over_time(left, _one_episode(steps, strategy), "speed")
    left.set(xlabel="time [s]", ylabel="speed [m/s]")
    owner = shorten(in_words(strategy), 40, placeholder="…")
    left.set_title(f"one episode: {owner}", pad=16)
    legend_above(left)
    against = str(report.against)
    what, _, unit = report.label.removesuffix("]").partition(" [")
    saved = table["saved_pct"].mask(table["strategy"] == against, 0.0)  # none after collisions
    dots(right, range(len(table)), table.assign(saved_pct=saved), "saved_pct", INK)
    right.axvline(0.0, color=SOFT, lw=0.8, zorder=0)
    rows_of(right, list(table["strategy"]))
    for place, value in enumerate(column_cells(table, report.score)):
        look: dict[str, Any] = {"va": "center", "ha": "right", "fontsize": 7}
        transform = right.get_yaxis_transform()
        right.annotate(f"{value} {unit}", (1.0, place), xycoords=transform, **look)
    low, high = right.get_xlim()
    right.set_xlim(low, high + 0.3 * (high - low))
    right.set(xlabel=f"{what} saved\nagainst {in_words(against)} [%]")
    size = size_of(episodes["profile_id"].nunique(), episodes["driver_id"].nunique(), "")
    right.set_title(LINES.format(size), pad=16)
    return figure


@paper
def measures_of(report: Report, seeds: Sequence[Report] = ()) -> Figure:
    """All columns of a report's short table except zeros: a dot per strategy, grey ones by seed.

    Args:
        report: report of one or several sources, in ``of``.
        seeds: the report of each training seed.
    """
    table = report.short.assign(of=report.short.get("of", ""))
    names = table["of"] + ": " + table["driver"]
    if "seeds" in {one.key for one in report.shown}:
        names += [f", {several(count, 'seed')}" * bool(count) for count in table["seeds"]]
    labels = [fill(name.removeprefix(": "), 28) for name in names]
    places = {tuple(key): place for place, key in enumerate(table[["of", "strategy"]].to_numpy())}
    shown = [one for one in report.shown if is_numeric_dtype(table[one.key])]
    shown = [one for one in shown if one.key not in COUNTS]
    shown = [one for one in shown if table[one.key].any()] or shown
    size = LINES.format(report.size) * bool(report.size)
    lines = [size, report.caption.removesuffix(ALL).rstrip("; "), *report.remarks]
    note = "\n".join(fill(line, 120) for line in lines if line)
    height = 0.17 * len("\n".join(labels).splitlines()) + 0.12 * len(note.splitlines())
    figure = new_figure(PAGE_WIDTH, 1.0 + height)
    figure.supxlabel(note, x=0.01, ha="left", fontsize=6)
    axes = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    for axis, (key, head) in zip(axes, shown, strict=True):
        every = (one.short.assign(of=one.short.get("of", "")) for one in seeds if key in one.short)
        for own in every:
            rows = [places[tuple(x)] for x in own[["of", "strategy"]].to_numpy()]
            axis.plot(own[key], rows, "o", color=SOFT, markersize=2)
        bounds = {f"{key}_{end}": table.get(f"{key}_{end}", table[key]) for end in ("low", "high")}
        dots(axis, range(len(table)), table.assign(**bounds), key, INK)
        axis.set(xlabel=head.replace("-\n", ""))
        axis.set_xlim(left=0.0 if key.startswith(COLLISIONS.key) else None)  # of equal counts, too
    axes[0].set_yticks(range(len(labels)), labels)
    axes[0].invert_yaxis()
    return figure


def _over_time(axis: Axes, rows: pd.DataFrame, entry: str) -> None:
    for vehicle, (name, hue) in VEHICLE_STYLES.items():
        column = f"{vehicle}_{entry}"
        if column in rows and rows[column].notna().any():
            axis.plot(rows["time_s"], rows[column], color=hue, label=name)


def _one_episode(steps: pd.DataFrame, strategy: str) -> pd.DataFrame:
    """Return the episode of :func:`most_varied`, with columns for one car and one human driver."""
    rows = most_varied(steps)
    rows = of_first_seed(rows[rows["strategy"] == strategy])
    # Of several vehicles, the first automated one and the human driver behind it.
    rows = rows.rename(columns=lambda name: re.sub(r"^cav1_", "cav_", name))
    behind = 1 + int(rows["cav_place"].iloc[0] if "cav_place" in rows else 0)
    return rows.rename(columns=lambda name: re.sub(f"^hdv{behind}_", "hdv_", name))


def human_energy_figure(means: Means, strategy: str) -> Figure:
    """Energy of human drivers behind the controlled car and directly behind the leader (Fig. 9)."""
    names = {"direct": "directly behind the leader", strategy: f"behind {in_words(strategy)}"}
    return _by_driver(means, "hdv_path_energy_kj", names, "the human driver")


def paired_improvement(means: Means, strategy: str, baseline: str) -> Figure:
    """Path energy of all vehicles by driver and its saving against a baseline (Fig. 10)."""
    names = {name: in_words(name) for name in (baseline, strategy)}
    return _by_driver(means, "total_path_energy_kj", names, "all vehicles")


@paper
def _by_driver(means: Means, column: str, names: dict[str, str], owner: str) -> Figure:
    """Draw the energies of all drivers with a baseline and a strategy, and their savings.

    Args:
        means: means of an evaluation.
        column: the energy.
        names: labels of the baseline and of the strategy, in this order.
        owner: vehicles with this energy, for the label of the axis.
    """
    baseline, strategy = names
    # Rounded to joules, so that bins have a width if all drivers are equal.
    energy = by_driver(means.drivers, column)[[baseline, strategy]].dropna().round(3)
    figure = new_figure(PAGE_WIDTH, 2.7)
    left, right = figure.subplots(1, 2)
    bins = np.histogram_bin_edges(energy.to_numpy(), 30)
    for (name, label), alpha in zip(names.items(), (0.45, 0.6), strict=True):
        mean = f"{label}, mean of drivers {energy[name].mean():.1f}"
        left.hist(energy[name], bins, color=colour(name), alpha=alpha, label=mean)
    left.set(xlabel=f"path energy of {owner}\n[kJ per {means.per}]", ylabel="drivers")
    left.xaxis.set_major_locator(MaxNLocator(5))
    left.yaxis.set_major_locator(MaxNLocator(integer=True))
    legend_above(left, 1)
    saving = share_saved(energy[strategy], energy[baseline])
    ordered = 100 * np.sort(saving.to_numpy())  # a bar per driver; negative values are losses
    right.bar(np.arange(1, len(ordered) + 1), ordered, width=1.0, color=colour(strategy), zorder=2)
    right.axhline(0.0, color=INK, lw=0.6)
    right.xaxis.set_major_locator(MaxNLocator(5, integer=True, min_n_ticks=1))
    found = means.saving(column, strategy, baseline)
    _mean_line(right, found, means.windows.loc[means.windows["strategy"] == strategy])
    worse = f"{int((saving < 0).sum())} of {len(saving)} drivers worse off"
    right.set(xlabel=f"drivers, sorted ({worse})", ylabel=f"path energy saved\nper {means.per} [%]")
    return figure


def _mean_line(axis: Axes, found: Estimate, rows: pd.DataFrame) -> None:
    """Draw the mean saving and its interval, and label both."""
    value, low, high = found.percent
    text = f"mean {signed(value)} %"
    if np.isfinite(low):
        seeds = min(rows["training_seed"].nunique(), 2)
        over = f"{varied_in(rows)}{('', ', 1 seed', ' and seeds')[seeds]}"
        limits = axis.get_ylim()  # of few drives the band may be far wider than all bars
        axis.axhspan(low, high, color=SOFT, alpha=0.3, lw=0)
        axis.set_ylim(limits)
        text += f" ({between(low, high, '{:+.1f}')})\nband: 95 % interval over {over}"
    else:
        text += " (1 window, 1 training seed: no interval)"
    axis.axhline(value, color=INK, lw=0.8, ls="--", zorder=3)
    axis.set_title(text, fontsize=7)
