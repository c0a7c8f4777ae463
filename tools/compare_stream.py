"""Compare the synthetic stream with real car-following pairs in a table and a figure.

    python tools/compare_stream.py --real i80_pairs.parquet --out stream.png

The real file is an episode table in parquet, see lcc_rl.data.episodes, or trajectories in any
published NGSIM layout, which then pass the same extraction as the stream.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import pandas as pd

from lcc_rl.data.sources import EpisodesSource, NgsimSource
from lcc_rl.data.statistics import ROLES, compare_statistics, leader_statistics
from lcc_rl.errors import LccError
from lcc_rl.figures.leaders import save_leaders
from lcc_rl.synthetic.stream import StreamSource


def read_real(path: str) -> pd.DataFrame:
    """Episodes of a parquet table or of an NGSIM file."""
    source = (
        EpisodesSource(path=path) if Path(path).suffix == ".parquet" else NgsimSource(path=path)
    )
    return source.load().episodes


def compare(real: str, seed: int, out: str | None, role: str) -> None:
    """Print the table and draw the figure."""
    reference, synthetic = read_real(real), StreamSource(seed=seed).load().episodes
    table = compare_statistics(
        leader_statistics(reference, role), leader_statistics(synthetic, role)
    )
    table["deviation"] = [f"{100.0 * value:+.1f} %" for value in table["deviation"]]
    table = table.rename(columns={"reference": "real", "other": "stream"})
    print(f"{role}s of {Path(real).name} and of the synthetic stream, seed {seed}")
    print(table.to_string(index=False, float_format="{:.3f}".format))
    if out is not None:
        save_leaders({"real": reference, "synthetic stream": synthetic}, out)
        print(f"figure: {out}")


def main() -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--real", required=True, help="episode table or NGSIM file")
    parser.add_argument("--out", help="figure to write: png, pdf or svg")
    parser.add_argument("--seed", type=int, default=0, help="seed of the stream")
    parser.add_argument("--role", choices=ROLES, default="leader", help="whose motion the table is")
    arguments = parser.parse_args()
    try:
        compare(arguments.real, arguments.seed, arguments.out, arguments.role)
    except LccError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
