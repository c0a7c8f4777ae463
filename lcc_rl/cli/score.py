"""Score a policy or controller on all tasks that it fits, for all sources of leaders.

    lcc-rl score policy.onnx      # or a run, pretrained/<name>, idm_acc …
    lcc-rl score outputs/train/<run> --task i24-follow5 --on everyday
    lcc-rl score idm --source i24 leader=i24 leader.path=i24_leaders.parquet

Prints a table and writes score.json with scores, intervals over drives, limits, versions, and
hashes of the leaders' windows, of all settings and of the policy's file. The rows of all episodes
are in the same folder. Further words are settings of all tasks, except the variant; they change the
hash of the settings.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from lcc_rl.config.words import check_overrides
from lcc_rl.runs.arguments import Arguments
from lcc_rl.runs.interrupts import ending_quietly
from lcc_rl.runs.output import HEADLINE


def main(arguments: Sequence[str] | None = None) -> int:
    """Score and print the table."""
    parser = Arguments(prog="lcc-rl score", description=__doc__)
    parser.add_argument("policy", help="ONNX file, run, policy file or controller")
    parser.add_argument("--name", help="name in tables; by default that of the file")
    parser.add_argument("--task", action="append", help="only this task; repeat for several")
    parser.add_argument("--on", action="append", default=[], help="only this source")
    parser.add_argument(
        "--source",
        nargs="+",
        action="append",
        default=[],
        metavar=("NAME", "SETTING"),
        help="a further source of leaders, such as i24 leader=i24 leader.path=…",
    )
    parser.add_argument("--out", type=Path, help="folder, by default below outputs/score")
    parser.add_trust()
    options, further = parser.parse_known_args(arguments)
    with ending_quietly():  # loads torch
        from lcc_rl.commands.score import SET_BY_SCORE, run
        from lcc_rl.results.board import score_table
        from lcc_rl.results.render import print_table
    check_overrides(further, SET_BY_SCORE, "each task has its own; --task and --source choose")
    logging.basicConfig(level=HEADLINE, format="%(message)s")  # without details
    document = run(options, further)
    print_table(score_table(document["name"], document["results"]))
    for line in document["left_out"]:
        Console().print(f"left out: {line}", highlight=False, markup=False)
    return 0
