"""Savings in energies of raw and of averaged speeds, for docs/limits.md."""

from __future__ import annotations

import pandas as pd
from fleets import percent

from lcc_rl.config.words import RECORDED
from lcc_rl.energy import AVERAGED, AVERAGES
from lcc_rl.results.measures import FLOW
from lcc_rl.results.names import NETWORK, in_words
from lcc_rl.results.render import markdown_row, signed
from lcc_rl.results.windows import DISTANCE, savings

SOURCES = {  # of what is kept, for readers
    "i80": "I-80",
    "ring": "ring",
    "openacc": "OpenACC, test track and low speed",
    "platoons": "OpenACC, motorways (`data=platoons`)",
}
ENERGIES = [f"all_{name}" for name in ("path_energy_kj", *AVERAGED)]
RIVALS = (RECORDED, "idm_acc_filtered")


def averaged(rows: pd.DataFrame) -> str:
    """Return a Markdown table: what the network saves by source, longest time gap and rival.

    Args:
        rows: ``source``, ``time_gap`` of the filter [s], ``average_s`` of the leaders [s],
            strategy and window, with :data:`ENERGIES`, distance and flow.
    """
    head = ["traffic, longest time gap", "against", "raw"]
    head += [f"{seconds:g} s" for seconds in AVERAGES]
    lines = [[*head, "flow"], ["---"] * (len(head) + 1)]
    raw = rows[rows["average_s"] == 0.0]
    for source, words in SOURCES.items():
        for gap, part in raw[raw["source"] == source].groupby("time_gap", sort=False):
            flow = part.groupby("strategy")[FLOW].mean()
            for rival in RIVALS:
                gained = signed(100.0 * (flow[NETWORK] / flow[rival] - 1.0))
                found = (savings(part, x, NETWORK, rival, [DISTANCE]) for x in ENERGIES)
                cells = [f"{words}, {gap:g} s", in_words(rival), *map(percent, found)]
                lines.append([*cells, f"{gained} %"])
    return "\n".join(map(markdown_row, lines))
