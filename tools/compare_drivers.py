"""Calibrate every driver model by several objectives; errors in and out of sample, as one table.

    python tools/compare_drivers.py data=episodes data.path=pairs.parquet \\
        --save outputs/reference/driver_models.parquet

Everything else is an option of ``lcc-rl calibrate``, such as ``calibration=local``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from time import process_time

import pandas as pd

from lcc_rl.config import load
from lcc_rl.drivers.fit import ERRORS, OUT
from lcc_rl.envs.inputs import build_source
from lcc_rl.errors import LccError
from lcc_rl.functional.laws import LAWS
from lcc_rl.io.files import write_parquet
from lcc_rl.nodes import CALLED, build
from lcc_rl.schemas import CalibrateConfig

OBJECTIVES = ("speed_rmspe", "gap_rmse")
DEFAULTS = ("calibration=global", "calibration.holdout=0.3")
HEAD = ("model", "objective", "RMSPE", "gap RMSE", "RMSPE, held out", "gap RMSE, held out")


def calibrated(cfg: CalibrateConfig, episodes: pd.DataFrame) -> pd.DataFrame:
    """Calibrate all drivers as a configuration says.

    Args:
        cfg: configuration of ``lcc_rl.calibrate``.
        episodes: the episodes.

    Returns:
        One row per mode: model, objective, holdout, seed, number of drivers, mean, median and
        95th percentile of every error, and the seconds of the processor.
    """
    calibrator = build(cfg.calibration, "calibration", CALLED)
    start = process_time()
    drivers = calibrator(episodes, seed=cfg.seed).drivers
    seconds = process_time() - start
    settings = {name: cfg.calibration[name] for name in ("model", "objective", "holdout")}
    columns = [x + end for x in ERRORS.values() for end in ("", OUT) if x + end in drivers]
    rows = []
    for mode, part in drivers.groupby("mode", sort=False):
        row = {**settings, "mode": mode, "seed": cfg.seed, "drivers": len(part)}
        for column in columns:
            row[column] = part[column].mean()
            row[f"{column}_median"] = part[column].median()
            row[f"{column}_p95"] = part[column].quantile(0.95)
        rows.append({**row, "seconds": seconds})
    return pd.DataFrame(rows)


def compare(overrides: Sequence[str]) -> pd.DataFrame:
    """Calibrate every model by every objective.

    Args:
        overrides: options of ``lcc_rl.calibrate``.

    Raises:
        LccError: if an option or the data are not what was expected.
    """
    words = [*DEFAULTS, *overrides]
    episodes = build_source(load("calibrate", words).data).load().episodes
    return pd.concat(
        [
            calibrated(
                load("calibrate", [*words, f"calibration.model={x}", f"calibration.objective={y}"]),
                episodes,
            )
            for x in LAWS
            for y in OBJECTIVES
        ],
        ignore_index=True,
    )


def table(rows: pd.DataFrame) -> str:
    """Return the means as a Markdown table."""
    lines = ["| " + " | ".join(HEAD) + " |", "|---" * len(HEAD) + "|"]
    for row in rows.to_dict("records"):
        shown = [row["model"].upper() if row["model"] != "gipps" else "Gipps", row["objective"]]
        for end in ("", OUT):
            known = f"rmspe{end}" in row
            shown += [f"{100 * row[f'rmspe{end}']:.1f} %" if known else "–"]
            shown += [f"{row[f'gap_rmse_m{end}']:.2f} m" if known else "–"]
        lines.append("| " + " | ".join(shown) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("overrides", nargs="*", help="options of lcc_rl.calibrate")
    parser.add_argument("--save", metavar="PATH", help="parquet file for the rows")
    options = parser.parse_args(arguments)
    try:
        rows = compare(options.overrides)
        if options.save:
            write_parquet(rows, options.save)
    except LccError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(table(rows))
    print(f"{int(rows['drivers'].iloc[0])} drivers, {rows['seconds'].sum():.0f} s in all")
    return 0


if __name__ == "__main__":
    sys.exit(main())
