"""How the options of the former release are spelt today."""

from __future__ import annotations

from collections.abc import Sequence

UNEXPECTED = "scenario.filters.automated.braking_ahead=0.01"
OPTIONS = {
    # The filter reckoned with no braking of the vehicle ahead beyond that measured.
    "variant=barrier": f"variant=cbf,{UNEXPECTED}",
    "+filter=barrier": f"+filter=cbf,{UNEXPECTED}",
    "scenario.followers=5": "scenario.string='automated human*5'",
    "scenario.pieces.memory.sources=[leader.speed,cav.gap]": (
        "scenario.pieces.memory.sources=[ahead.speed,self.gap]"
    ),
    "agent.sampled=true": (
        "scenario.controllers.automated.desired_speed=null,"
        "scenario.controllers.automated.time_gap=null"
    ),
    "agent.lookahead=oracle": "scenario.controllers.automated.lookahead=oracle",
    "controller.lookahead=oracle": "deployed.lookahead=oracle",
    "controller.jerk_bound=10": "deployed.jerk_bound=10",
}


def renamed(overrides: Sequence[str]) -> list[str]:
    """Return overrides of the former release as those of today."""
    found: list[str] = []
    # A platoon's leader drives records: data=… never had an effect and is refused today.
    records = any(item in overrides for item in ("variant=ddpg", "variant=hcfs"))
    for item in overrides:
        if records and item.startswith("data."):
            continue
        new = OPTIONS.get(item, item)
        found += new.split(",") if ",scenario." in new else [new]
    return found
