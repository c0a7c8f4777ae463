"""Run the same sweep with every launcher and compare the rows.

    python tools/compare_launchers.py --out outputs/launchers
    ray-environment/bin/python tools/compare_launchers.py serial ray --out outputs/launchers

Launchers that are not installed are left out. The second command, in Ray's environment, compares
with the finished serial sweep of the first. The exit code is 1 if a row differs.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage

import pandas as pd

from benchmarks.harness import installed
from lcc_rl import results

# Override and package of each launcher.
LAUNCHERS = {
    "serial": ("hydra/launcher=basic", "hydra"),
    "joblib": ("hydra/launcher=lcc_joblib", "hydra_plugins.hydra_joblib_launcher"),
    "submitit": ("hydra/launcher=lcc_submitit_local", "hydra_plugins.hydra_submitit_launcher"),
    "ray": ("hydra/launcher=lcc_ray", "hydra_plugins.hydra_ray_launcher"),
}
TABLES = ("training", "episodes", "steps")  # timing.parquet holds seconds
SMALL = ("experiment=smoke", "agent.batch_size=64", "agent.hidden=[16,16]")


@dataclass(frozen=True)
class Spent:
    """Time of a sweep.

    Args:
        wall_s: wall-clock time [s].
        cpu_s: processor time of the sweep [s].
        others_s: processor time of all other processes meanwhile [s].
    """

    wall_s: float
    cpu_s: float
    others_s: float

    def __str__(self) -> str:
        cores = len(os.sched_getaffinity(0))
        whole = cores * self.wall_s
        return (
            f"{self.wall_s:.0f} s, {self.cpu_s / whole:.0%} of {cores} cores; others took "
            f"{self.others_s / whole:.0%}, of the rest {self.cpu_s / (whole - self.others_s):.0%}"
        )


def busy() -> float:
    """Return the processor time of all processes since the machine started [s]."""
    first = Path("/proc/stat").read_text().splitlines()[0].split()
    user, nice, system = map(int, first[1:4])
    return (user + nice + system) / os.sysconf("SC_CLK_TCK")


def sweep(launcher: str, words: Sequence[str], folder: Path) -> Spent:
    """Run the sweep with a launcher, into the folder of its name.

    Raises:
        RuntimeError: if it fails, with its output.
    """
    typed = [sys.executable, "-m", "lcc_rl.train", "-m", *words, LAUNCHERS[launcher][0]]
    typed += [f"hydra.sweep.dir={launcher}"]
    begun, used, all_used = time.monotonic(), getrusage(RUSAGE_CHILDREN), busy()
    done = subprocess.run(typed, cwd=folder, capture_output=True, text=True)
    wall, now, all_now = time.monotonic() - begun, getrusage(RUSAGE_CHILDREN), busy()
    if done.returncode != 0:
        raise RuntimeError(f"{launcher}: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    own = now.ru_utime - used.ru_utime + now.ru_stime - used.ru_stime
    return Spent(wall, own, max(0.0, all_now - all_used - own))


def check_same(folder: Path, one: str, two: str) -> int:
    """Compare every row of two sweeps, bit for bit; return how many rows there are.

    Raises:
        AssertionError: naming the first difference.
    """
    rows = 0
    for table in TABLES:
        first, second = (results.load(folder / x, table) for x in (one, two))
        pd.testing.assert_frame_equal(first, second, check_exact=True)
        rows += len(first)
    return rows


def run(launchers: Sequence[str], words: Sequence[str], folder: Path) -> bool:
    """Run the sweep with every launcher and print its time; False if rows differ."""
    same = True
    for launcher in launchers:
        if not installed(LAUNCHERS[launcher][1]):
            print(f"{launcher:<9} left out: not installed here")
            continue
        print(f"{launcher:<9} {sweep(launcher, words, folder)}", flush=True)
        try:
            rows = check_same(folder, launchers[0], launcher)
            print(f"{'':<9} {rows} rows, those of {launchers[0]}", flush=True)
        except AssertionError as error:
            same = False
            print(f"{'':<9} differs from {launchers[0]}: {error}", flush=True)
    return same


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare the launchers given on the command line with the first of them."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("launchers", nargs="*", metavar="launcher", help=", ".join(LAUNCHERS))
    parser.add_argument("--seeds", type=int, default=4, help="of each of two variants")
    parser.add_argument("--episodes", type=int, default=24, help="of each training")
    parser.add_argument("--out", type=Path, help="keep the sweeps here; they are found again")
    options = parser.parse_args(arguments)
    for name in options.launchers:
        if name not in LAUNCHERS:
            parser.error(f"unknown launcher {name}; valid: {', '.join(LAUNCHERS)}")
    seeds, count = ",".join(map(str, range(options.seeds))), f"training.episodes={options.episodes}"
    words = [*SMALL, "variant=alcc,reference", f"seed={seeds}", count]
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.out or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        return 0 if run(options.launchers or list(LAUNCHERS), words, folder) else 1


if __name__ == "__main__":
    sys.exit(main())
