"""Maps of the policies of an evaluation: which are drawn, where, and their rows."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from lcc_rl.config.schemas import StudyConfig
from lcc_rl.errors import LccError, ResultsError
from lcc_rl.evaluation.responses import responses
from lcc_rl.evaluation.strategies import Strategy, baseline
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.pieces.controllers import Population
from lcc_rl.results.motion import RESPONSES, Motion, motion_of, sample_episodes, visited

log = logging.getLogger("lcc_rl")

MOST = 3  # learned strategies
POINTS = 41  # along either axis
LEAST_GAP, LEAST_REACH = 10.0, 2.0  # of the axes: largest gap [m], relative speed [m/s]


def write_responses(
    strategies: Sequence[Strategy],
    cfg: StudyConfig,
    population: Population,
    folder: Path,
    metadata: Mapping[str, str],
) -> None:
    """Write what the learned strategies and a tuned rule do over gap and relative speed.

    At two speeds, and within axes, that the sample episodes of the learned ones visit; nothing
    where nothing was learned or no episode is kept. A strategy that cannot drive everywhere there
    is left out.

    Args:
        strategies: of the evaluation.
        cfg: its configuration.
        population: the human drivers.
        folder: holds steps.parquet; gets responses.parquet.
        metadata: of the table.

    Raises:
        ResultsError: if a file cannot be read or written.
    """
    (folder / RESPONSES).unlink(missing_ok=True)  # of other strategies
    own = [s for s in strategies if s.policy is not None and not s.name.endswith("oracle")]
    learned = list({s.name: s for s in reversed(own)}.values())[:MOST]
    motions = _motions(read_parquet(folder / "steps.parquet"), learned, cfg) if learned else []
    if not motions:
        return
    grid, tables = grid_of(motions), []
    platoon = cfg.scenario.pieces.get("communication") is not None
    rule = baseline(cfg, "cacc tuned" if platoon else "idm tuned")
    for strategy in (*reversed(learned), rule):
        try:
            tables.append(responses(strategy, population, *grid))
        except LccError as error:
            log.info("no map of %s: %s", strategy.name, error)
    if any(table["strategy"].iloc[0] != rule.name for table in tables):
        write_parquet(pd.concat(tables, ignore_index=True), folder / RESPONSES, metadata)


def _motions(steps: pd.DataFrame, strategies: Sequence[Strategy], cfg: StudyConfig) -> list[Motion]:
    """Return the sample episodes that there are of strategies."""
    found = []
    for strategy in strategies:
        try:
            episodes = sample_episodes(steps, strategy.name)
            found += [motion_of(rows, vars(cfg.scenario)) for rows in episodes.values()]
        except ResultsError:  # none was kept
            continue
    return found


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
