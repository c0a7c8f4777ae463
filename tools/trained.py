"""What trained policies save against drivers and an IDM at their flow, for docs/learners.md."""

from __future__ import annotations

import fleets
import pandas as pd

from lcc_rl.results.fronts import fleet_saved, flow_gained, saved_at_flow
from lcc_rl.results.render import markdown_table

TASKS_TRAINED = {"alcc": "ALCC", "i24-follow5": "`i24-follow5`"}
LEARNERS = {
    "idm_acc": "tuned IDM",
    "analytic": "gradient (`analytic`)",
    "limit": "gradient, limit of spacing",
    "ppo": "PPO",
    "td3": "TD3",
    "sac": "SAC",
    "ddpg": "DDPG",
}
MEASURED = (  # with what a learner is compared, and how
    (fleets.HUMAN, fleet_saved),
    (fleets.HUMAN, flow_gained),
    ("idm", saved_at_flow),
)


def learner_savings(rows: pd.DataFrame) -> str:
    """Return a Markdown table with a row per task and learner, means of its seeds.

    Args:
        rows: a row per training and window: ``task``, ``variant``, ``policy`` (empty),
            ``training_seed``, ``limit`` (time gap of ``idm`` [s]), ``profile_id``, ``drive``,
            ``start_s``, energy, distance, flow, and ``minutes`` of the training.
    """
    head = ["task", "driven by", "seeds", "saved", "flow", "saved against an IDM at its flow"]
    lines = []
    for task, label in TASKS_TRAINED.items():
        part = rows[rows["task"] == task]
        for name, words in LEARNERS.items():
            own = part[part["variant"] == name]
            if own.empty:
                continue
            cells = [label, words, str(own["training_seed"].nunique())]
            for other, measure in MEASURED:
                cells.append(fleets.percent(fleets.against(part, other, measure, name, "")))
            minutes = own["minutes"].mean()
            lines.append([*cells, f"{minutes:.1f}" if minutes > 0.0 else "–"])
    return markdown_table([*head, "minutes"], lines)
