"""How fast a controller ends a wave on the ring: python tools/damping.py <policy or controller>…

On task=ring-22 a human drives the automated vehicle for 300 s, while a wave grows; then the
controller takes over for 300 s. The damping time is how long after that the spread of the speeds
last exceeds 0.5 m/s; missing where it still does so at the end. Rows go to --reference.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from omegaconf import OmegaConf
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.config import load
from lcc_rl.envs import build_env, load_inputs
from lcc_rl.evaluation.rollout import play
from lcc_rl.evaluation.strategies import rules, with_weights
from lcc_rl.io.files import write_parquet
from lcc_rl.results.policies import load_policy
from lcc_rl.runs.cli import main_guard

FROM_S, STEP_S, CALM = 300.0, 0.1, 0.5
ROOT = Path(__file__).resolve().parents[1]
EPISODES = 4


def driven(name: str) -> dict[str, Tensor]:
    """Drive the episodes of ring-22 with a handover; return speeds and gaps over time."""
    cfg = load("evaluate", ["variant=alcc", "task=ring-22"])
    OmegaConf.set_struct(cfg, False)
    inputs, rule = load_inputs(cfg), name in rules() and not Path(name).exists()
    node = OmegaConf.load(ROOT / "conf" / "controller" / f"{name if rule else 'action'}.yaml")
    after: dict[str, Any] = {"_target_": "lcc_rl.pieces.Handover", "from_s": FROM_S, "after": node}
    cfg.scenario.controllers.automated = after | {"before": "${scenario.controllers.human}"}

    def nothing(td: TensorDictBase) -> TensorDictBase:
        return td.set(("automated", "action"), torch.zeros(EPISODES, 1, 1))

    policy: Any = nothing
    if rule:
        cfg.scenario.filters = {}
    else:
        weights, own = load_policy(name)
        cfg.observation = own.observation
        policy = with_weights(own, weights, own.seed, name, inputs.population).policy
    env = build_env(cfg, inputs.evaluation, inputs.population, EPISODES, 0, nominal=True)
    record, _ = play(env, policy, None, [("vehicles", "speed"), ("vehicles", "gap")])
    return {key[1]: entry.squeeze(-1) for key, entry in record.items()}


def measured(name: str) -> pd.DataFrame:
    """Return a row per episode: damping time, spread, mean speed and smallest own gap."""
    found, begin = driven(name), round(FROM_S / STEP_S)
    after = found["speed"][begin:]
    spread = after.std(-1, correction=0)
    times = STEP_S * torch.arange(1, len(after) + 1).unsqueeze(-1)
    last = torch.where(spread > CALM, times, 0.0).amax(0)
    damped = torch.where(last < times[-1], last, torch.nan)
    return pd.DataFrame(
        {
            "strategy": name,
            "episode": range(EPISODES),
            "damping_time_s": damped.numpy(),
            "final_speed_spread_mps": spread[-600:].mean(0).numpy(),
            "mean_speed_mps": after.mean((0, 2)).numpy(),
            "min_gap_m": found["gap"][begin:, :, 0].amin(0).numpy(),
        }
    )


def main(words: Sequence[str] | None = None) -> int:
    """Measure the controllers named."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="+", help="policies or controllers")
    reference = Path("outputs/reference/tasks/damping.parquet")
    parser.add_argument("--reference", type=Path, default=reference, help="where rows are kept")
    options = parser.parse_args(words)
    table = pd.concat(map(measured, options.names), ignore_index=True)
    write_parquet(table, options.reference)
    print(table.groupby("strategy", sort=False).mean(numeric_only=True).round(2).to_string())
    return 0


if __name__ == "__main__":
    sys.exit(main_guard(main)())
