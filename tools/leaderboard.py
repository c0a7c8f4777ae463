"""Write the tables of docs/tasks.md and docs/leaderboard.md: python tools/leaderboard.py <run>…

That of the leaderboard is of the files of lcc-rl score in outputs/reference/scores.

Each run is an evaluation with task=…. Its scores, and the time that each strategy takes for a
decision, measured here for one vehicle, are kept below --reference. Without runs the tables are
written again from the kept scores.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Hashable, Mapping, Sequence
from functools import partial
from pathlib import Path
from timeit import repeat
from typing import Any

import numpy as np
import pandas as pd
import torch
from torchrl.envs import TransformedEnv

from lcc_rl.cli.guard import main_guard
from lcc_rl.commands.evaluation import strategies_of, task_of
from lcc_rl.config.schemas import EvaluateConfig
from lcc_rl.envs import build_env
from lcc_rl.envs.inputs import build_energy
from lcc_rl.envs.step import entries, pieces_of
from lcc_rl.errors import ConfigError, require
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.pieces import Controller
from lcc_rl.results.board import as_markdown
from lcc_rl.results.cells import signed
from lcc_rl.results.headline import saved
from lcc_rl.results.names import in_words
from lcc_rl.results.runs import load_config
from lcc_rl.results.scores import FLOW, LEAST, SHARE, Task, keeps, limited, scores

BEGIN, END = "<!-- tables: tools/leaderboard.py -->", "<!-- end of tables -->"
DECISIONS, WARM_UP = 200, 20
LIMIT = "limit_"
REFERENCE, PAGE = Path("outputs/reference/tasks"), Path("docs/tasks.md")
SCORES, BOARD = Path("outputs/reference/scores"), Path("docs/leaderboard.md")


def decision_ms(strategy: Strategy, env: TransformedEnv) -> float:
    """Return the median time [ms] that a strategy takes to decide for the vehicles of one string.

    The time is that of the network with its TensorDict, or of a rule's controller.
    """
    td, policy = env.reset(), strategy.policy
    if policy is not None:
        seen = td.select(*getattr(policy, "in_keys", ()), strict=False)
        decide = partial(policy, seen)
    else:
        pieces = [x for x in pieces_of(env) if isinstance(x, Controller) and x.role == AUTOMATED]
        moment = entries(td)
        decide = partial(pieces[0].compute, *(moment[key] for _, key in pieces[0].needs))
    with torch.no_grad():
        spent = repeat(decide, repeat=WARM_UP + DECISIONS, number=1)
    return float(np.median(spent[WARM_UP:])) * 1e3


def task_scores(folder: Path) -> tuple[EvaluateConfig, Task, pd.DataFrame, pd.DataFrame]:
    """Return the configuration of an evaluation, its task, its episodes and their scores.

    Raises:
        ConfigError: if it has no task.
    """
    cfg = load_config(folder)
    task = task_of(cfg)
    if task is None:
        raise ConfigError(f"{folder}: an evaluation without task=…")
    rows = read_parquet(folder / "episodes.parquet")
    return cfg, task, rows, scores(rows, task.among(rows["strategy"]), build_energy(cfg))


def scored(folder: Path) -> tuple[str, pd.DataFrame]:
    """Return the name of an evaluation's task and the scores of its strategies, to be kept."""
    cfg, task, rows, table = task_scores(folder)
    strategies, inputs = strategies_of(cfg)
    spent = {}
    for strategy in strategies:
        if AUTOMATED in strategy.cfg.scenario.vehicles.names:
            env = build_env(strategy.cfg, inputs.evaluation, inputs.population, 1, nominal=True)
            spent[strategy.name] = decision_ms(strategy, env)
    table["decision_ms"] = table["strategy"].map(spent)
    table["windows"] = rows["profile_id"].nunique()
    table = table.assign(**{f"{LIMIT}{key}": value for key, value in task.limits.items()})
    return task.name, table.assign(score_name=task.score, unit=task.unit, against=task.against)


def drawn(task: Task, table: pd.DataFrame) -> str:
    """Return the Markdown table of a task; the kept scores hold every measure."""
    head = ["driven by", task.label, "saved [%]", "distance [%]", "flow [1/h] (%)", "limits"]
    lines = [[*head, "decision [ms]"]]
    whole = table.set_index("strategy").loc[task.against, FLOW]
    for row in table.to_dict("records"):
        share = (100.0 * row[f"saving{end}"] for end in ("", "_low", "_high"))
        cells = [
            in_words(str(row["strategy"])),
            f"{row['score']:.2f}",
            saved(*share),
            signed(-100.0 * row["distance_lost"]),
            f"{row[FLOW]:,.0f} ({signed(100.0 * (row[FLOW] / whole - 1.0))})",
            "kept" if row["kept"] else broken(task, row),
            f"{row['decision_ms']:.2f}" if np.isfinite(row["decision_ms"]) else "",
        ]
        lines.append(cells)
    first, *others = ("| " + " | ".join(cells) + " |" for cells in lines)
    bounds = ", ".join(bounded(column, bound) for column, bound in task.limits.items())
    words = f"Saved against {in_words(task.against)}. Limits: {bounds or 'no collision'}."
    return "\n".join([words, "", first, "|" + "---|" * len(lines[0]), *others])


def bounded(column: str, bound: float) -> str:
    """Return a column and its limit in words."""
    return f"{limited(column)} {'≥' if column.startswith(LEAST) else '≤'} {measured(column, bound)}"


def broken(task: Task, row: Mapping[Hashable, Any]) -> str:
    """Return the limits that are not kept with their values, or the collisions."""
    found = [
        f"{limited(column)} {measured(column, row[column])}"
        for column, bound in task.limits.items()
        if not keeps(column, row[column], bound)
    ]
    return "; ".join(found) or f"{row['collisions']} collisions"


def measured(column: str, value: float) -> str:
    """Return a value of a limited column with its unit."""
    if column.startswith(SHARE):
        return f"{100.0 * value:.2f} %"
    return f"{value:.0f} m" if column.endswith("_m") else f"{value:.2f} s"


def write_tables(reference: Path, page: Path) -> None:
    """Write the tables of all kept scores into the page.

    Raises:
        ConfigError: if the page lacks the marks.
    """
    parts = []
    for path in sorted(reference.glob("*.parquet")):
        table = read_parquet(path)
        if "score_name" not in table:  # of fleets
            continue
        first = {str(key): value for key, value in table.iloc[0].items()}
        limits = {x.removeprefix(LIMIT): float(first[x]) for x in first if x.startswith(LIMIT)}
        given = {"score": first["score_name"], "unit": first["unit"], "against": first["against"]}
        task = Task(name=path.stem, limits=limits, **given)
        parts.append(f"### {path.stem}\n\n{first['windows']} windows. {drawn(task, table)}\n")
    _write_between(page, parts)


def write_board(scores: Path, page: Path) -> None:
    """Write the table of all files of ``lcc-rl score`` in a folder into the page."""
    documents = {
        path.name: json.loads(path.read_text(encoding="utf-8"))
        for path in sorted(scores.glob("*.json"))
    }
    _write_between(page, [as_markdown(documents)])


def _write_between(page: Path, parts: Sequence[str]) -> None:
    """Replace what stands between the marks of a page."""
    text = page.read_text(encoding="utf-8")
    require(BEGIN in text and END in text, f"{page}: it lacks the lines {BEGIN} and {END}")
    before, after = text.partition(BEGIN)[0], text.partition(END)[2]
    with atomic_path(page) as part:
        part.write_text(
            "\n".join([f"{before}{BEGIN}\n", *parts, f"{END}{after}"]), encoding="utf-8"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Keep the scores of the runs given and write the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", nargs="*", type=Path, help="folders of evaluations with task=…")
    parser.add_argument("--reference", type=Path, default=REFERENCE, help="where scores are kept")
    parser.add_argument("--name", help="of the scores of a single run, if not the task's")
    parser.add_argument("--page", type=Path, default=PAGE, help="the page to write into")
    options = parser.parse_args(arguments)
    require(options.name is None or len(options.runs) == 1, "--name is of a single run")
    for folder in options.runs:
        name, table = scored(folder)
        write_parquet(table, options.reference / f"{options.name or name}.parquet")
    write_tables(options.reference, options.page)
    write_board(SCORES, BOARD)
    print(f"written: {options.page}, {BOARD}")
    return 0


if __name__ == "__main__":
    sys.exit(main_guard(main)())
