"""Tables and figures of compare_agents.py, from the parquet files of its trainings."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from lcc_rl import results
from lcc_rl.config import short_name
from lcc_rl.errors import ResultsError
from lcc_rl.figures.drawing import INK, in_words, legend_above, new_figure, style
from lcc_rl.io.files import read_parquet

PREVIEWS = (1.0, 2.0, 5.0, 10.0)  # [s]
KNOWN = ("none", "memory", *(f"preview_{seconds:g}s" for seconds in PREVIEWS))
EPISODES, KEPT, FILTERED = "episodes.parquet", "kept.parquet", "filtered.parquet"
HUES = {"analytic": "#0072b2", "ddpg": "#d55e00", "td3": "#009e73", "sac": "#cc79a7"}
ENERGY, UNSAFE, LONG = "total_energy_kj", "share_ttc_unsafe", "share_time_gap_long"
LOST = "total_acceleration_loss_kj"
MEANS = (ENERGY, LOST, UNSAFE, LONG)


def table_of_agents(folder: Path) -> pd.DataFrame:
    """Return one row per run: energy, safety, and the time and steps that it trained.

    Raises:
        ResultsError: if no training is finished.
    """
    rows = []
    for path in sorted(folder.rglob(EPISODES)):
        episodes = results.load(path.parent)
        first = episodes.iloc[0].to_dict()
        row = {
            "run": str(path.parent.relative_to(folder)),
            "variant": first["strategy"],
            "agent": short_name(first.get("agent._target_", "none")),
            "seed": first["seed"],
            **{name: episodes[name].mean() for name in MEANS},
            "net_energy_kj": episodes["total_net_energy_kj"].mean(),
            "collisions": int(episodes["collided"].sum()),
            "episodes": len(episodes),
        }
        if (path.parent / "timing.parquet").exists():
            timing, training = (results.load(path.parent, x) for x in ("timing", "training"))
            row["train_s"] = (timing["collect_s"] + timing["learn_s"]).sum()
            row["env_steps"] = training["transitions"].iloc[-1]
        rows.append(row)
    if not rows:
        raise ResultsError(f"{folder}: no finished training below it")
    return pd.DataFrame(rows)


def figure_of_agents(folder: Path) -> Figure:
    """Held-out energy and training reward over wall time and over steps, every run a line."""
    table = table_of_agents(folder)
    if "train_s" not in table:
        raise ResultsError(f"{folder}: no finished training below it, only what learns nothing")
    learned = table[table["train_s"].notna()]
    figure = new_figure(9.0, 6.4)
    axes = figure.subplots(2, 2, sharex="col", sharey="row")
    ends = []
    for run in learned.to_dict("records"):
        curve = course(folder / run["run"])
        look = {"color": HUES.get(run["agent"], INK), "lw": 1.1, "alpha": 0.8}
        look["ls"] = "-" if run["variant"] == "alcc" else ":"
        kept = curve.dropna(subset=[ENERGY])
        ends += kept[ENERGY].tail(len(kept) // 2).tolist()
        for column, x in enumerate(("minutes", "transitions")):
            axes[0, column].plot(kept[x], kept[ENERGY], marker=".", **look)
            axes[1, column].plot(curve[x], curve["smooth"], **look)
    human = table.loc[table["variant"] == "idm", ENERGY]
    for axis in axes[0] if len(human) else ():
        axis.axhline(float(human.iloc[0]), color=INK, lw=0.8, ls="--")
    if ends:  # the first policies of a training would set the scale
        ends += human.tolist()
        axes[0, 0].set_ylim(min(ends) - 2.0, max(ends) + 2.0)
    axes[1, 0].set_ylim(-60.0, 0.0)
    for axis, words in zip(axes[1], ("training time [min]", "environment steps"), strict=True):
        style(axis, words, "")
        axis.set_xscale("log")
    style(axes[0, 0], "", "held-out total energy\n[kJ per episode]")
    style(axes[0, 1], "", "")
    style(axes[1, 0], "training time [min]", "reward per training episode\n(mean of 10 batches)")
    for agent in dict.fromkeys(learned["agent"]):
        axes[0, 0].plot([], [], color=HUES.get(agent, INK), label=agent)
    legend_above(axes[0, 0], 4)
    note = "; solid: alcc, dotted: others" if learned["variant"].nunique() > 1 else ""
    note += "; dashed: a human in the car's place" if len(human) else ""
    figure.supxlabel(f"a line per training{note}", fontsize=8)
    return figure


def course(folder: Path) -> pd.DataFrame:
    """Return the course of a training: minutes, steps, reward; held-out energy where kept."""
    training, timing = (results.load(folder, name) for name in ("training", "timing"))
    frame = training[["iteration", "transitions"]].copy()
    frame["minutes"] = (timing["collect_s"] + timing["learn_s"]).cumsum() / 60.0
    frame["smooth"] = training["episode_reward"].rolling(10, min_periods=1).mean()
    path = folder / KEPT
    kept = read_parquet(path) if path.exists() else pd.DataFrame({"iteration": [], ENERGY: []})
    return frame.merge(kept, on="iteration", how="left")


def table_of_knowledge(folder: Path) -> pd.DataFrame:
    """Return one row per kind of knowledge: energy and safety, without and with the filter.

    Raises:
        ResultsError: if no training is finished.
    """
    runs = runs_by_knowledge(folder)
    filtered = [folder / run / FILTERED for run in runs["run"]]
    behind = pd.concat([read_parquet(p) if p.exists() else pd.DataFrame([{}]) for p in filtered])
    behind = behind.reset_index(drop=True).reindex(columns=[*MEANS, "collided"])
    runs = runs.join(behind.add_prefix("filtered_"))
    grouped = runs.groupby("knowledge")
    table = grouped[[*MEANS, "net_energy_kj", "collisions"]].mean()
    table = table.join(grouped[[f"filtered_{name}" for name in MEANS]].mean())
    table["energy_sd"], table["seeds"] = grouped[ENERGY].std(), grouped.size()
    for base in ("none", "idm"):
        if base in table.index:
            for prefix in ("", "filtered_"):
                own = f"{prefix}{ENERGY}"
                compared = float(table[ENERGY if base == "idm" else own][base])
                table[f"{prefix}saving_vs_{base}"] = 1.0 - table[own] / compared
    return table.reset_index()


def runs_by_knowledge(folder: Path) -> pd.DataFrame:
    """Return one row per run with its kind of knowledge, the first part of its folder's name."""
    runs = table_of_agents(folder)
    runs["knowledge"] = [Path(run).parts[0] for run in runs["run"]]
    return runs


def figure_of_knowledge(folder: Path) -> Figure:
    """Energy, losses and limits against knowledge."""
    return drawn_knowledge(table_of_knowledge(folder), runs_by_knowledge(folder))


def drawn_knowledge(table: pd.DataFrame, runs: pd.DataFrame) -> Figure:
    """Draw the means of :func:`table_of_knowledge`, and a dot per training.

    Args:
        table: a row per kind of knowledge, shares of the time from 0 to 1.
        runs: a row per training; none where only the means are kept.
    """
    table = table.set_index("knowledge")
    learned = table.loc[[kind for kind in KNOWN if kind in table.index]]
    places = pd.Series(range(len(learned)), learned.index)
    runs = runs[runs["knowledge"].isin(learned.index)]
    human = table.loc["idm"] if "idm" in table.index else None
    words = {ENERGY: "total energy\n[kJ per episode]", LOST: "lost to accelerating\n[kJ]"}
    figure = new_figure(8.0, 6.6)
    axes = figure.subplots(3, 1, sharex=True)
    looks = {
        "": ("#0072b2", "as trained", -0.08),
        "filtered_": ("#d55e00", "behind the filter", 0.08),
    }
    for prefix, (hue, label, shift) in looks.items():
        look = {"color": hue, "marker": "o", "ls": ""}
        for axis, name in zip(axes, words, strict=False):
            axis.plot(places + shift, learned[prefix + name], label=label, **look)
        gap = f"time gap > 2.5 s, {label}"
        axes[-1].plot(places + shift, 100.0 * learned[prefix + LONG], label=gap, **look)
    for axis, (name, label) in zip(axes, words.items(), strict=False):
        axis.plot(
            places[runs["knowledge"]].to_numpy() - 0.16, runs[name], ".", color="#0072b2", alpha=0.5
        )
        if human is not None:
            axis.axhline(human[name], color=INK, lw=0.8, ls="--", label="human driver")
        style(axis, "", label)
    unsafe = {"marker": "^", "ls": "", "color": "#0072b2", "mfc": "none"}
    axes[-1].plot(places, 100.0 * learned[UNSAFE], label="TTC < 4 s, as trained", **unsafe)
    axes[-1].set_ylim(bottom=0.0)
    axes[-1].set_xticks(places, [in_words(kind) for kind in learned.index])
    style(axes[-1], "what the car knows besides the present", "share of time [%]")
    legend_above(axes[0])
    legend_above(axes[-1], 2)
    return figure
