"""Compare agents, and what it is worth to know more than the present.

    python tools/compare_agents.py agents data=ngsim data.path=...      # ddpg, td3, sac, analytic
    python tools/compare_agents.py agents training.keep_every=5 ...     # ... and on the way there
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
from lcc_rl.config import load, require, short_name
from lcc_rl.envs.factory import load_inputs
from lcc_rl.errors import ResultsError
from lcc_rl.evaluate import trained
from lcc_rl.evaluation.monte_carlo import evaluate
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.pipeline import root_key
from lcc_rl.results.drawing import new_figure, save
from lcc_rl.results.figures import style
from lcc_rl.results.runs import load_policy
from lcc_rl.runs.cli import main_guard, prepare_torch
from lcc_rl.runs.sweeps import key_of
from lcc_rl.studies.runner import FINISHED, Run, check_overrides, run_all
from lcc_rl.train import POLICIES

log = logging.getLogger("lcc_rl")

AGENTS = ("analytic", "ddpg", "td3", "sac")
PREVIEWS = (1.0, 2.0, 5.0, 10.0)  # [s]; ten speeds, evenly spread up to there
KNOWN = ("none", "memory", *(f"preview_{seconds:g}s" for seconds in PREVIEWS))
EPISODES, KEPT, FILTERED = "episodes.parquet", "kept.parquet", "filtered.parquet"
POLICY = "policy.pt"
HUES = {"analytic": "#0072b2", "ddpg": "#d55e00", "td3": "#009e73", "sac": "#cc79a7"}
ENERGY, UNSAFE, LONG = "total_energy_kj", "share_ttc_unsafe", "share_time_gap_long"
LOST = "total_acceleration_loss_kj"
MEANS = (ENERGY, LOST, UNSAFE, LONG)


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
    """Return trainings without, with memory and with previews of several lengths, and idm."""
    kinds: dict[str, list[str]] = {"none": [], "memory": ["+knowledge=memory"]}
    for seconds in PREVIEWS:
        ahead = ",".join(f"{seconds * part / 10:g}" for part in range(1, 11))
        horizons = f"scenario.pieces.preview.horizons=[{ahead}]"
        kinds[f"preview_{seconds:g}s"] = ["+knowledge=preview", horizons]
    runs = [
        Run(
            options.out / kind / f"seed_{seed}",
            (f"agent={options.agent}", f"seed={seed}", *changes, *options.overrides),
        )
        for kind, changes in kinds.items()
        for seed in range(options.seeds)
    ]
    return [*runs, Run(options.out / "idm", ("variant=idm", *data_overrides(options.overrides)))]


def data_overrides(overrides: Iterable[str]) -> list[str]:
    """Keep the overrides that mean something to a controller that learns nothing."""
    known = ("data", "split", "drivers", "evaluation", "scenario", "experiment", "trust", "device")
    own = tuple(f"scenario.pieces.{piece}." for piece in ("barrier", "preview", "memory"))
    return [
        item for item in overrides if root_key(item) in known and not key_of(item).startswith(own)
    ]


def evaluate_kept(options: argparse.Namespace) -> None:
    """Evaluate the policies that each finished training kept on its way: kept.parquet beside."""
    kept = {folder: sorted((folder / POLICIES).glob("*.pt")) for folder in finished(options.out)}
    todo = {folder: paths for folder, paths in kept.items() if paths and outdated(folder, paths)}
    if not todo:
        return
    judge = evaluator(options.overrides)
    for folder, paths in todo.items():
        log.info("%s: evaluating the policies kept on the way", folder)
        rows = [{"iteration": float(path.stem), **judge(path)} for path in paths]
        write_parquet(pd.DataFrame(rows), folder / KEPT)


def evaluate_filtered(options: argparse.Namespace) -> None:
    """Evaluate what was trained behind the filter: filtered.parquet beside."""
    todo = [
        folder
        for folder in finished(options.out)
        if (folder / POLICY).exists()
        and not ((folder / FILTERED).exists() and newer(folder / FILTERED, folder / POLICY))
    ]
    if not todo:
        return
    judge = evaluator(options.overrides, "+filter=barrier")
    for folder in todo:
        log.info("%s: evaluating the policy behind the filter", folder)
        write_parquet(pd.DataFrame([judge(folder)]), folder / FILTERED)


def finished(folder: Path) -> list[Path]:
    """Return the folders of all runs below that were evaluated."""
    return [path.parent for path in sorted(folder.rglob(EPISODES))]


def newer(path: Path, than: Path) -> bool:
    """Whether a file was written after another one."""
    return path.stat().st_mtime >= than.stat().st_mtime


def evaluator(overrides: Iterable[str], *further: str) -> Callable[[Path], dict[str, float]]:
    """Return what evaluates a policy's file or folder on the held-out profiles, to its means."""
    cfg = load("evaluate", [*data_overrides(overrides), *further])
    prepare_torch(cfg)
    inputs, size, trust = load_inputs(cfg), cfg.evaluation, tuple(cfg.trust)

    def judge(path: Path) -> dict[str, float]:
        strategy = trained(cfg, str(path), load_policy(path, trust=trust), inputs)
        who = (inputs.evaluation, inputs.population, size.drivers, size.batch_size, size.seed)
        episodes, _ = evaluate(strategy, *who, device=cfg.device)
        return {name: float(episodes[name].mean()) for name in (*MEANS, "collided")}

    return judge


def outdated(folder: Path, policies: list[Path]) -> bool:
    """Whether kept.parquet of a training is missing or of other policies than these."""
    path = folder / KEPT
    numbers = [float(policy.stem) for policy in policies]
    return not path.exists() or read_parquet(path)["iteration"].tolist() != numbers


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
            "agent": short_name(first["agent._target_"]),
            "seed": first["seed"],
            **{name: episodes[name].mean() for name in MEANS if name in episodes},
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
        look = {"color": HUES.get(run["agent"], "#222222"), "lw": 1.1, "alpha": 0.8}
        look["ls"] = "-" if run["variant"] == "alcc" else ":"
        kept = curve.dropna(subset=[ENERGY])
        ends += kept[ENERGY].tail(len(kept) // 2).tolist()
        for column, x in enumerate(("minutes", "transitions")):
            axes[0, column].plot(kept[x], kept[ENERGY], marker=".", **look)
            axes[1, column].plot(curve[x], curve["smooth"], **look)
    human = table.loc[table["variant"] == "idm", ENERGY]
    for axis in axes[0] if len(human) else ():
        axis.axhline(float(human.iloc[0]), color="#222222", lw=0.8, ls="--")
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
        axes[1, 0].plot([], [], color=HUES.get(agent, "#222222"), label=agent)
    axes[1, 0].legend(frameon=False, loc="lower right")
    note = "a line per training; solid: alcc, dotted: reference; dashed: a human in the car's place"
    figure.supxlabel(note, fontsize=8)
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
    """Return one row per kind of knowledge: what it is worth, without and behind the filter.

    Raises:
        ResultsError: if no training is finished.
    """
    runs = runs_by_knowledge(folder)
    filtered = [folder / run / FILTERED for run in runs["run"]]
    behind = pd.concat([read_parquet(p) if p.exists() else pd.DataFrame([{}]) for p in filtered])
    behind = behind.reset_index(drop=True).reindex(columns=[*MEANS, "collided"])
    runs = runs.join(behind.add_prefix("filtered_"))
    grouped = runs.groupby("knowledge")
    numbers = [name for name in MEANS if name in runs]
    table = grouped[[*numbers, "net_energy_kj", "collisions"]].mean()
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
    """Return one row per run and what its car knows: ``<knowledge>/seed_<n>``, or ``idm``."""
    runs = table_of_agents(folder)
    runs["knowledge"] = [Path(run).parts[0] for run in runs["run"]]
    return runs


def figure_of_knowledge(folder: Path) -> Figure:
    """Energy, losses and limits against what the car knows; a point per training, lines of means.

    What accelerating loses is left out where an earlier release evaluated.
    """
    table = table_of_knowledge(folder).set_index("knowledge")
    learned = table.loc[[kind for kind in KNOWN if kind in table.index]]
    runs = runs_by_knowledge(folder)
    runs = runs[runs["knowledge"].isin(learned.index)]
    human = table.loc["idm"] if "idm" in table.index else None
    shown = [name for name in (ENERGY, LOST) if name in table]
    figure = new_figure(7.0, 2.2 + 2.0 * len(shown))
    axes = figure.subplots(len(shown) + 1, 1, sharex=True)
    looks = {"": ("#0072b2", "as trained"), "filtered_": ("#d55e00", "behind the filter")}
    for prefix, (hue, label) in looks.items():
        look = {"color": hue, "marker": "o", "lw": 1.2}
        for axis, name in zip(axes, shown, strict=False):
            axis.plot(learned.index, learned[prefix + name], label=label, **look)
        axes[-1].plot(learned.index, 100.0 * learned[prefix + LONG], **look)
    dots = {"color": "#0072b2", "marker": ".", "alpha": 0.5, "ls": ""}
    for axis, name in zip(axes, shown, strict=False):
        axis.plot(runs["knowledge"], runs[name], **dots)
        if human is not None:
            axis.axhline(human[name], color="#222222", lw=0.8, ls="--", label="human driver")
    axes[-1].plot(learned.index, 100.0 * learned[UNSAFE], "o:", color="#0072b2", lw=1.2)
    words = {ENERGY: "total energy\n[kJ per episode]", LOST: "lost to accelerating\n[kJ]"}
    for axis, name in zip(axes, shown, strict=False):
        style(axis, "", words[name])
    axes[0].legend(frameon=False, fontsize=8)
    axes[-1].set_ylim(bottom=0.0)
    style(axes[-1], "what the car knows besides the present", "share of time [%]")
    note = "bottom: solid, time gap > 2.5 s; dotted, TTC < 4 s as trained"
    figure.supxlabel(note, fontsize=8)
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
        evaluate_kept(options)
        if part == "knowledge":
            evaluate_filtered(options)
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
    check_overrides(overrides)
    require(options.jobs >= 1 and options.seeds >= 1, "--jobs and --seeds must be at least 1")
    options.overrides = overrides
    logging.basicConfig(level=logging.INFO, format="[%(asctime)s] %(message)s", datefmt="%H:%M:%S")
    return perform(options.part, options)


if __name__ == "__main__":
    sys.exit(main_guard(main)(sys.argv[1:]))
