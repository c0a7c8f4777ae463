"""Print the table of an evaluation again, or as rows for a paper or a program.

lcc-rl table outputs/evaluate/<run>
lcc-rl table outputs/evaluate/<run> --format latex > table.tex
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from lcc_rl.api import Run
from lcc_rl.cli.guard import main_guard
from lcc_rl.io.files import as_rows
from lcc_rl.results.cells import as_latex, as_markdown
from lcc_rl.results.headline import for_print
from lcc_rl.results.runs import EPISODES, FINAL, PARTS, load_config, reading
from lcc_rl.runs.arguments import Arguments

FORMATS: dict[str, Callable[[Run], str]] = {
    "text": str,
    "markdown": lambda run: as_markdown(for_print(run.headline)),
    "latex": lambda run: as_latex(for_print(run.headline)),
    "csv": lambda run: run.headline.to_csv(index=False).rstrip(),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table of a run."""
    parser = Arguments(prog="lcc-rl table", description=__doc__)
    parser.add_argument("run", type=Path, help="folder of an evaluation, a training or a job")
    parser.add_argument("--format", choices=FORMATS, default="text")
    parser.add_argument("--trust", action="append", default=[], help="module that it may name")
    options = parser.parse_args(arguments)
    run: Path = options.run
    folder = run / FINAL if (run / PARTS).is_dir() else run
    cfg = load_config(folder, options.trust)
    with reading(folder / EPISODES):
        print(FORMATS[options.format](Run(folder, as_rows(folder / EPISODES), cfg)))


if __name__ == "__main__":
    main_guard(main)()
