"""Write the tables of tasks: python tools/leaderboard.py outputs/evaluate/<run>… (docs/tasks.md).

Each run is an evaluation with task=…; its scores, and the time that each strategy takes for a
decision, measured here for one vehicle, are kept below --reference. Without runs the tables are
written again from what is kept there.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torchrl.envs import TransformedEnv

from lcc_rl.commands.evaluation import strategies_of
from lcc_rl.commands.tasks import task_of
from lcc_rl.energy import build_energy
from lcc_rl.envs import build_env
from lcc_rl.envs.inputs import string_of
from lcc_rl.envs.step import entries, pieces_of
from lcc_rl.errors import LccError, require
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.pieces import Controller
from lcc_rl.results.runs import load_config
from lcc_rl.results.scores import LEAST, SHARE, Task, scores

BEGIN, END = "<!-- tables: tools/leaderboard.py -->", "<!-- end of tables -->"
DECISIONS, WARM_UP = 200, 20
REFERENCE = "outputs/reference/tasks"


def decision_ms(strategy: Strategy, env: TransformedEnv) -> float:
    """Return the median time [ms] that a strategy takes to decide for the vehicles of one string.

    Of a learned policy the network with its TensorDict, of a rule the controller.
    """
    td, policy = env.reset(), strategy.policy
    if policy is not None:
        seen = td.select(*getattr(policy, "in_keys", ()), strict=False)

        def decide() -> object:
            return policy(seen)
    else:
        (controller,) = (
            piece
            for piece in pieces_of(env)
            if isinstance(piece, Controller) and piece.role == AUTOMATED
        )
        moment = entries(td)
        values = [moment[key] for _, key in controller.needs]

        def decide() -> object:
            return controller.compute(*values)

    spent = []
    with torch.no_grad():
        for _ in range(WARM_UP + DECISIONS):
            begun = time.perf_counter()
            decide()
            spent.append(time.perf_counter() - begun)
    return float(np.median(spent[WARM_UP:])) * 1e3


def scored(folder: Path) -> tuple[Task, pd.DataFrame]:
    """Return the task of an evaluation and the scores of its strategies.

    Raises:
        ConfigError: if it is of no task.
    """
    cfg = load_config(folder)
    task = task_of(cfg)
    require(task is not None, f"{folder}: an evaluation without task=…")
    assert task is not None
    table = scores(read_parquet(folder / "episodes.parquet"), task, build_energy(cfg))
    strategies, inputs = strategies_of(cfg)
    spent = {}
    for strategy in strategies:
        if AUTOMATED in string_of(strategy.cfg).names:
            env = build_env(strategy.cfg, inputs.evaluation, inputs.population, 1, nominal=True)
            spent[strategy.name] = decision_ms(strategy, env)
    table["decision_ms"] = table["strategy"].map(spent)
    episodes = read_parquet(folder / "episodes.parquet")
    table["windows"] = episodes["profile_id"].nunique()
    return task, table


def drawn(task: Task, table: pd.DataFrame) -> str:
    """Return the Markdown table of a task."""
    head = [
        "strategy",
        task.label,
        f"saved against {task.against}",
        "distance lost",
        *(_bound(column, bound) for column, bound in task.limits.items()),
        "spread at the end",
        "per decision",
    ]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in table.to_dict("records"):
        interval = f"{row['saving']:+.1%} ({row['saving_low']:+.1%} … {row['saving_high']:+.1%})"
        cells = [
            f"**{row['strategy']}**" if row["kept"] else str(row["strategy"]),
            f"{row['score']:.2f}",
            interval if np.isfinite(row["saving"]) else "",
            f"{row['distance_lost']:+.1%}",
            *(_value(column, row[column]) for column in task.limits),
            f"{row['final_speed_spread_mps']:.2f} m/s",
            f"{row['decision_ms']:.2f} ms" if np.isfinite(row["decision_ms"]) else "",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _bound(column: str, bound: float) -> str:
    sign = "≥" if column.startswith(LEAST) else "≤"
    number = f"{bound:.2%}" if column.startswith(SHARE) else f"{bound:g}"
    return f"{column} {sign} {number}"


def _value(column: str, value: float) -> str:
    if not np.isfinite(value):
        return ""
    return f"{value:.2%}" if column.startswith(SHARE) else f"{value:.2f}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the tables; 1 where the input is at fault."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("runs", nargs="*", type=Path, help="folders of evaluations with task=…")
    parser.add_argument("--reference", type=Path, default=REFERENCE, help="where scores are kept")
    parser.add_argument("--page", type=Path, default="docs/tasks.md", help="the page to write into")
    options = parser.parse_args(arguments)
    reference, page = Path(options.reference), Path(options.page)
    try:
        for folder in options.runs:
            task, table = scored(folder)
            kept = table.assign(**{f"limit_{key}": value for key, value in task.limits.items()})
            kept = kept.assign(score_name=task.score, unit=task.unit, against=task.against)
            write_parquet(kept, reference / f"{task.name}.parquet")
        parts = []
        for path in sorted(reference.glob("*.parquet")):
            table = read_parquet(path)
            if "score_name" not in table:  # of fleets, of damping
                continue
            found = [name for name in map(str, table.columns) if name.startswith("limit_")]
            first = table.iloc[0]
            limits = {name.removeprefix("limit_"): float(first[name]) for name in found}
            how = (first["score_name"], first["unit"], first["against"], limits)
            task = Task(path.stem, *how)
            parts += [f"### {path.stem}\n\n{int(first['windows'])} windows.\n", drawn(task, table)]
            parts.append("")
        text = page.read_text()
        require(BEGIN in text and END in text, f"{page}: it lacks the lines {BEGIN} and {END}")
        before, _, rest = text.partition(BEGIN)
        tables = "\n".join(parts)
        with atomic_path(page) as part:
            part.write_text(f"{before}{BEGIN}\n\n{tables}\n{END}{rest.partition(END)[2]}")
    except (LccError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
