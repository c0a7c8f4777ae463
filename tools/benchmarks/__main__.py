"""``python tools/benchmarks``: see :mod:`benchmarks.command`."""

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).parents[1])  # so that this folder is the package ``benchmarks``

from benchmarks.command import main  # noqa: E402
from lcc_rl.cli.guard import main_guard  # noqa: E402

if __name__ == "__main__":
    sys.exit(main_guard(main)())
