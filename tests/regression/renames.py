"""How the options of the former release are spelt today."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

# The platoon's policy that shipped then.
PLATOON_POLICY = Path(__file__).parent / "reference" / "ddpg.pt"
UNEXPECTED = "scenario.filters.automated.braking_ahead=0.01"
OPTIONS: dict[str, str | tuple[str, ...]] = {
    # The filter reckoned with no braking of the vehicle ahead beyond that measured.
    "variant=barrier": ("variant=cbf", UNEXPECTED),
    "+filter=barrier": ("+filter=cbf", UNEXPECTED),
    "scenario.followers=5": "scenario.string='automated human*5'",
    "scenario.pieces.memory.sources=[leader.speed,cav.gap]": (
        "scenario.pieces.memory.sources=[ahead.speed,self.gap]"
    ),
    "agent.sampled=true": (
        "scenario.controllers.automated.desired_speed=null",
        "scenario.controllers.automated.time_gap=null",
    ),
    "agent.lookahead=oracle": "scenario.controllers.automated.lookahead=oracle",
    "controller.lookahead=oracle": "deployed.lookahead=oracle",
    "controller.jerk_bound=10": "deployed.jerk_bound=10",
    "gains=paper_like": ("gains.k1=0.072", "gains.k2=0.168", "gains.k3=0.939", "gains.k4=0.023"),
}


def renamed(overrides: Sequence[str]) -> list[str]:
    """Return overrides of the former release as those of today."""
    found: list[str] = []
    # A platoon's leader drives records: data=… never had an effect and is refused today.
    records = any(item in overrides for item in ("variant=ddpg", "variant=hcfs"))
    for item in overrides:
        if records and item.startswith("data."):
            continue
        if records and item == "policy=pretrained":
            item = f"policy='{PLATOON_POLICY}'"
        new = OPTIONS.get(item, item)
        found += [new] if isinstance(new, str) else new
    return found
