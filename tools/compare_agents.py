"""Compare agents, and what it is worth to know more than the present.

    python tools/compare_agents.py agents data=ngsim data.path=...      # ddpg, td3, sac, analytic
    python tools/compare_agents.py knowledge data=ngsim data.path=...   # memory and preview

Each runs trainings into ``--out``, then reads their parquet files and writes a table and a
figure. The same command goes on where it stopped and skips what is finished; ``--draw`` only
draws what is there. Whatever is no option is an override of every training.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from lcc_rl import results
from lcc_rl.cli import main_guard
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.results.drawing import new_figure, save
from lcc_rl.results.files import write_parquet
from lcc_rl.results.study_figures import colour, style
from lcc_rl.studies.runner import FINISHED, Run, run_all

log = logging.getLogger("lcc_rl")

AGENTS = ("analytic", "ddpg", "td3", "sac")
PREVIEWS = (1.0, 2.0, 5.0, 10.0)  # [s]; five speeds, evenly spread up to there
EPISODES = "episodes.parquet"
ENERGY, UNSAFE, LONG = "total_energy_kj", "share_ttc_unsafe", "share_time_gap_long"


def runs_of_agents(options: argparse.Namespace) -> list[Run]:
    """Return a training per agent, variant and seed, and the human baseline."""
    runs = [
        Run(
            options.out / agent / variant / f"seed_{seed}",
            (f"agent={agent}", f"variant={variant}", f"seed={seed}", *options.overrides),
        )
        for agent in options.agents
        for variant in options.variants
        for seed in range(options.seeds)
    ]
    return [*runs, Run(options.out / "idm", ("variant=idm", *data_overrides(options.overrides)))]


def runs_of_knowledge(options: argparse.Namespace) -> list[Run]:
    """Return a training without, with memory and with previews of several lengths, per seed."""
    kinds: dict[str, list[str]] = {"none": [], "memory": ["+knowledge=memory"]}
    for seconds in PREVIEWS:
        ahead = ",".join(f"{seconds * part / 5:g}" for part in range(1, 6))
        horizons = f"scenario.pieces.preview.horizons=[{ahead}]"
        kinds[f"preview_{seconds:g}s"] = ["+knowledge=preview", horizons]
    return [
        Run(
            options.out / kind / f"seed_{seed}",
            (f"agent={options.agent}", f"seed={seed}", *changes, *options.overrides),
        )
        for kind, changes in kinds.items()
        for seed in range(options.seeds)
    ]


def data_overrides(overrides: Iterable[str]) -> list[str]:
    """Keep the overrides that mean something to a controller that learns nothing."""
    known = ("data", "split", "drivers", "evaluation", "scenario", "experiment")
    return [item for item in overrides if item.lstrip("+~").split(".")[0].split("=")[0] in known]


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
            "agent": str(first["agent._target_"]).rpartition(".")[2].lower(),
            "seed": first["seed"],
            **{name: episodes[name].mean() for name in (ENERGY, UNSAFE, LONG)},
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
    """Reward against wall time and steps, and energy against wall time at the end."""
    table = table_of_agents(folder)
    learned = table[table["train_s"].notna()]
    figure = new_figure(11.0, 3.8)
    axes = figure.subplots(1, 3)
    for run in learned.to_dict("records"):
        training, timing = (results.load(folder / run["run"], x) for x in ("training", "timing"))
        wall = (timing["collect_s"] + timing["learn_s"]).cumsum() / 60.0
        smooth = training["episode_reward"].rolling(10, min_periods=1).mean()
        hue = colour(run["agent"])
        axes[0].plot(wall, smooth, color=hue, lw=1.0, alpha=0.8)
        axes[1].plot(training["transitions"], smooth, color=hue, lw=1.0, alpha=0.8)
        mark = "o" if run["variant"] == "alcc" else "s"
        axes[2].plot(run["train_s"] / 60.0, run[ENERGY], mark, color=hue)
    for agent in dict.fromkeys(learned["agent"]):
        axes[0].plot([], [], color=colour(agent), label=agent)
    for axis, words in zip(
        axes, ("training time [min]", "environment steps", "training time [min]"), strict=True
    ):
        style(axis, words, "reward per training episode")
        axis.set_xscale("log")
    for axis in axes[:2]:
        axis.set_ylim(-60.0, 0.0)
    human = table.loc[table["variant"] == "idm", ENERGY]
    if len(human):
        axes[2].axhline(float(human.iloc[0]), color="#222222", lw=0.8, ls="--", label="idm")
    style(axes[2], "training time [min]", "held-out total energy [kJ]")
    axes[2].set_title("○ alcc, □ reference; dashed: human", fontsize=9)
    axes[0].legend(frameon=False)
    return figure


def table_of_knowledge(folder: Path) -> pd.DataFrame:
    """Return one row per kind of knowledge: what it is worth.

    Raises:
        ResultsError: if no training is finished.
    """
    runs = table_of_agents(folder)
    runs["knowledge"] = [Path(run).parent.name for run in runs["run"]]
    grouped = runs.groupby("knowledge")
    table = grouped[[ENERGY, "net_energy_kj", UNSAFE, LONG, "collisions"]].mean()
    table["energy_sd"], table["seeds"] = grouped[ENERGY].std(), grouped.size()
    if "none" in table.index:
        table["saving"] = 1.0 - table[ENERGY] / float(grouped[ENERGY].mean()["none"])
    return table.reset_index()


def figure_of_knowledge(folder: Path) -> Figure:
    """Total energy against what the car knows."""
    table = table_of_knowledge(folder).sort_values(ENERGY, ascending=False)
    figure = new_figure(6.5, 3.6)
    axis = figure.subplots()
    error = table["energy_sd"].fillna(0.0)
    axis.errorbar(table["knowledge"], table[ENERGY], error, fmt="o", color=colour("alcc"))
    style(axis, "what the car knows besides the present", "total energy [kJ per episode]")
    return figure


Part = tuple[
    Callable[[argparse.Namespace], list[Run]],
    Callable[[Path], pd.DataFrame],
    Callable[[Path], Figure],
]
PARTS: dict[str, Part] = {
    "agents": (runs_of_agents, table_of_agents, figure_of_agents),
    "knowledge": (runs_of_knowledge, table_of_knowledge, figure_of_knowledge),
}


def perform(part: str, options: argparse.Namespace) -> int:
    """Run what is left to run, then write the table and the figure; 1 if a training failed."""
    plan, tabulate, draw = PARTS[part]
    failed = 0
    if not options.draw:
        outcomes = run_all(plan(options), options.jobs)
        wrong = [outcome for outcome in outcomes if outcome.status != FINISHED]
        for outcome in wrong:
            log.error("%s: %s: %s", outcome.run.folder, outcome.status, outcome.note)
        failed = int(bool(wrong))
    table = tabulate(options.out)
    write_parquet(table, options.out / f"{part}.parquet")
    save(draw(options.out), options.out / f"{part}.png")
    print(table.to_string(index=False, float_format="{:.4g}".format))
    log.info("table and figure: %s", options.out / f"{part}.png")
    return failed


def parser() -> argparse.ArgumentParser:
    """Return the command line: a subcommand per comparison."""
    form = argparse.RawDescriptionHelpFormatter
    top = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    commands = top.add_subparsers(required=True, dest="part")
    for part in PARTS:
        one = commands.add_parser(part)
        one.add_argument("--out", type=Path, default=Path("outputs/compare") / part)
        one.add_argument("--seeds", type=int, default=3, help="trainings of each kind")
        one.add_argument("--jobs", type=int, default=2, help="trainings at a time")
        one.add_argument("--draw", action="store_true", help="only draw what is finished")
        if part == "agents":
            one.add_argument("--agents", type=words, default=list(AGENTS))
            one.add_argument("--variants", type=words, default=["alcc", "reference"])
        else:
            one.add_argument("--agent", default="analytic")
    return top


def words(text: str) -> list[str]:
    """Split a list with commas."""
    return text.split(",")


def main(arguments: list[str]) -> int:
    """Run a comparison; whatever is no option is an override of every training."""
    options, overrides = parser().parse_known_args(arguments)
    if any(item.startswith("-") or "=" not in item for item in overrides):
        raise ConfigError(f"expected overrides such as data=stream, got {' '.join(overrides)}")
    options.overrides = overrides
    logging.basicConfig(level=logging.INFO, format="[%(asctime)s] %(message)s", datefmt="%H:%M:%S")
    return perform(options.part, options)


if __name__ == "__main__":
    sys.exit(main_guard(main)(sys.argv[1:]))
