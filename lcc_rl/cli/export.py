"""Export a policy for other software."""

from __future__ import annotations

from collections.abc import Sequence

from lcc_rl.config.words import check_once
from lcc_rl.runs.arguments import Arguments
from lcc_rl.runs.interrupts import ending_quietly


def main(arguments: Sequence[str] | None = None) -> int:
    """Export the policy of a command line."""
    parser = Arguments(prog="lcc-rl export", description=__doc__)
    parser.add_argument("policy", help="run folder, policy.pt, pretrained/<name> or a rule")
    parser.add_argument("path", help="file: a program (.onnx, .pt2, .c) or a page (.html)")
    parser.add_trust()
    text = "of a page's ring (drivers=i80), of a program (safety.margin=2 limits.max_braking=6), "
    text += "of a rule or a controller of your own (time_step=0.02)"
    parser.add_argument("settings", nargs="*", default=[], help=text)
    options = parser.parse_args(arguments)
    check_once(options.settings)
    with ending_quietly():  # loads torch
        from lcc_rl.interfaces.export import written
        from lcc_rl.interfaces.exported import described_input
    path, made = written(options.policy, options.path, options.trust, overrides=options.settings)
    if made is None:
        print(f"{path}: the ring road in the browser, with {options.policy}")
        return 0
    for column in map(described_input, made.names):
        print(f"  {column.name} [{column.unit}]: {column.meaning}")
    text = "maps these inputs, in this order, to the acceleration [m/s²]"
    print(f"{path}: {text}, every {made.controller.time_step:g} s")
    return 0
