"""Map the policies of an evaluation: lcc-rl maps outputs/evaluate/<run>.

A map shows the acceleration over gap and relative speed, at two speeds and within axes that the
sample episodes visit, of the learned strategies and of a tuned rule.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from lcc_rl.commands.animate import KEPT, with_steps
from lcc_rl.commands.evaluation import IDENTITY, strategies_of
from lcc_rl.config import identity
from lcc_rl.config.schemas import EvaluateConfig, as_plain
from lcc_rl.errors import ConfigError, LccError, ResultsError
from lcc_rl.evaluation.responses import responses
from lcc_rl.evaluation.strategies import baseline
from lcc_rl.figures.drawing import save
from lcc_rl.figures.policy_maps import policy_maps
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.results.motion import RESPONSES, Motion, motion_of, sample_episodes, visited
from lcc_rl.results.runs import STEPS, load_config, reading
from lcc_rl.runs.arguments import Arguments
from lcc_rl.runs.precision import prepare_torch

log = logging.getLogger("lcc_rl")

MOST = 3  # learned strategies
POINTS = 41  # along either axis
LEAST_GAP, LEAST_REACH = 10.0, 2.0  # of the axes: largest gap [m], relative speed [m/s]


def run(folder: str | Path, trust: Sequence[str] = ()) -> list[Path]:
    """Write responses.parquet of an evaluation and draw it; return the figures' paths.

    A strategy that cannot drive everywhere on the map is left out.

    Args:
        folder: of an evaluation or a main job.
        trust: modules outside this package that its configuration may name.

    Raises:
        LccError: if there is no such evaluation, or no sample episode of a learned strategy.
    """
    folder = with_steps(Path(folder))
    cfg = load_config(folder, trust)
    if not isinstance(cfg, EvaluateConfig):
        raise ConfigError(f"{folder}: not an evaluation; evaluate the policy first")
    prepare_torch(cfg)
    strategies, inputs = strategies_of(cfg, own=cfg.policy is not None)
    own = [s for s in strategies if s.policy is not None and not s.name.endswith("oracle")]
    learned = list({s.name: s for s in reversed(own)}.values())[:MOST]
    steps, scenario = read_parquet(folder / STEPS), vars(cfg.scenario)
    with reading(folder / STEPS):
        grid = grid_of(_motions(steps, [strategy.name for strategy in learned], scenario, folder))
    platoon = cfg.scenario.pieces.get("communication") is not None
    tables = []
    rule = "idm_acc_filtered" if cfg.scenario.filters.get(AUTOMATED) else "idm_acc"
    for strategy in (*reversed(learned), baseline(cfg, "cacc tuned" if platoon else rule)):
        try:
            tables.append(responses(strategy, inputs.population, *grid))
        except LccError as error:
            log.warning("no map of %s: %s", strategy.name, error)
    rows = pd.concat(tables, ignore_index=True)
    write_parquet(rows, folder / RESPONSES, {IDENTITY: identity(cfg)})
    return [
        save(figure, folder / "figures" / f"{stem}.png", formats=cfg.figure_formats)
        for stem, figure in policy_maps(rows, steps, as_plain(cfg))
    ]


def _motions(
    steps: pd.DataFrame, names: Sequence[str], scenario: dict[str, object], folder: Path
) -> list[Motion]:
    """Return the sample episodes that there are of strategies."""
    kept = [name for name in names if (steps["strategy"] == name).any()]
    if not kept:
        raise ResultsError(f"{folder}: holds no episode of a policy; evaluate one with {KEPT}")
    episodes = (sample_episodes(steps, name).values() for name in kept)
    return [motion_of(rows, scenario) for some in episodes for rows in some]


def grid_of(motions: Sequence[Motion]) -> tuple[list[float], list[float], list[float]]:
    """Return the speeds, gaps and relative speeds of maps that fit what was driven.

    Args:
        motions: sample episodes.
    """
    seen = np.concatenate([visited(motion) for motion in motions])
    speeds = sorted({max(round(float(x)), 1) for x in np.quantile(seen[:, 0], (0.25, 0.75))})
    gap = max(LEAST_GAP, 1.5 * float(np.quantile(seen[:, 1], 0.98)))
    reach = max(LEAST_REACH, 1.5 * float(np.quantile(np.abs(seen[:, 2]), 0.98)))
    gaps = np.linspace(0.5, np.ceil(gap), POINTS)
    return [float(x) for x in speeds], gaps.tolist(), np.linspace(-reach, reach, POINTS).tolist()


def main(words: Sequence[str] | None = None) -> int:
    """Map what is named on the command line; print the figures' names."""
    parser = Arguments(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of an evaluation or main job")
    parser.add_argument("--trust", action="append", default=[], help="module that it may name")
    given = parser.parse_args(words)
    for path in run(given.run, given.trust):
        print(path)
    return 0
