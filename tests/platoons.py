"""Shared by the platoon tests: leaders, actors of every quality, and a short way to play."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from helpers import ACTION, POPULATION, composed, string
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from lcc_rl.data.leaders import Case, RecordLeaders, stretch
from lcc_rl.data.profiles import Profiles, from_records, joined
from lcc_rl.envs import Inputs, build_env
from lcc_rl.evaluation.cases import CaseRuns
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.functional.cacc import next_leader_speed
from lcc_rl.functional.random import uniform
from lcc_rl.pieces.base import SEED, STEP

T, A_MAX = 0.2, 3.0
ACTORS = ("good", "bad", "random")


def leader(*speeds: Sequence[float] | Tensor) -> Profiles:
    """Records of given speeds, 0.2 s apart."""
    records = [torch.as_tensor(record, dtype=torch.float32) for record in speeds]
    names = [f"leader{i}" for i in range(len(records))]
    return from_records(records, names, names, T)


def ramps() -> Profiles:
    """Three leaders within ±2 m/s²: ramping up, wavering, braking to standstill and on."""
    time = T * torch.arange(101)
    up = (0.37 + 1.2 * (time - 4.0).clamp(min=0.0)).clamp(max=10.76)
    waver = 8.0 + 2.0 * torch.sin(time / 1.5)
    stop = (10.0 - 1.8 * time).clamp(min=0.0) + 1.5 * (time - 12.0).clamp(min=0.0)
    return leader(up, waver, stop)


@cache
def windows(limit: int | None = None) -> Profiles:
    """The held-out windows of the shipped default."""
    cfg = composed("variant=cacc")
    held = {k: dict(v) for k, v in cfg.leader.settings["held_out"].items()}
    found = RecordLeaders(training={"x": {"path": "udds"}}, held_out=held).load(T, 100, 6)
    return found.windows.spread(limit)


def whole(*records: tuple[str, float]) -> Profiles:
    """Whole records at a scale, side by side; a record that is over keeps its last speed."""
    profiles = joined([stretch(path, T, scale) for path, scale in records])
    longest = int(profiles.lengths.max())
    padded = []
    for index in range(len(profiles)):
        record = profiles.record(index)
        padded.append(torch.cat([record, record[-1:].expand(longest - len(record))]))
    return from_records(padded, profiles.names, profiles.recordings, T)


def repeated(profiles: Profiles, times: int) -> Profiles:
    """Every record so many times, one copy after another."""
    return profiles.select([i for _ in range(times) for i in range(len(profiles))])


@dataclass(frozen=True)
class Driver:
    """Who drives a platoon: the options that say so, and a policy where one acts."""

    overrides: tuple[str, ...]
    policy: Any = None


def cacc(name: str = "tuned") -> Driver:
    return Driver(("variant=cacc", f"gains={name}"))


def deadbeat(mode: str = "causal") -> Driver:
    return Driver(("variant=deadbeat", f"scenario.controllers.automated.lookahead={mode}"))


def hcfs(learned: Any = "good", rule: str = "tuned", **settings: Any) -> Driver:
    """The hybrid of CACC and an actor."""
    actor = Actor(learned) if isinstance(learned, str) else learned
    own = (f"deployed.{name}={value}" for name, value in settings.items())
    return Driver(("variant=hcfs", f"gains={rule}", *own), actor)


def wider(driver: Driver, headway: float) -> Driver:
    """The same driver in a platoon of another headway [m]."""
    own = f"scenario.start.automated.headway={headway}"
    return Driver((*driver.overrides, own), driver.policy)


def env_of(profiles: Profiles, driver: Driver, vehicles: int = 6, horizon: int | None = None):
    """The platoon's environment, a slot for every record, as in an evaluation."""
    horizon = int(profiles.lengths.min()) - 1 if horizon is None else horizon
    own = [f"scenario.horizon={horizon}", string(f"automated*{vehicles}")]
    cfg = composed(*driver.overrides, *own).after_training()
    return build_env(cfg, profiles, POPULATION, len(profiles), nominal=True)


def play(profiles: Profiles, driver: Driver, vehicles: int = 6) -> dict[str, Tensor]:
    """Drive behind every record from its start to its end."""
    cfg = composed(*driver.overrides).after_training()
    inputs = Inputs(profiles, profiles, POPULATION)
    case = Case("whole", profiles, vehicles)
    return CaseRuns(Strategy("tested", cfg, driver.policy), case, inputs).play()


class Actor(TensorDictModuleBase):
    """Stands in for a learned policy, good to dangerous.

    ``good`` is dead-beat, ``bad`` always accelerates, ``random`` draws from ±a_max, ``hasty``
    is dead-beat but 10 cm/s too fast, ``mixed`` gives every third of the batch another of the
    first three.
    """

    def __init__(self, kind: str) -> None:
        self.in_keys = [
            ("vehicles", "speed"),
            ("vehicles", "leader_speed"),
            ("vehicles", "leader_acceleration"),
            SEED,
            STEP,
        ]
        self.out_keys = [ACTION]
        super().__init__()
        self.kind = kind

    def action(self, kind: str, td: TensorDictBase) -> Tensor:
        speed, *heard = (
            td["vehicles", x] for x in ("speed", "leader_speed", "leader_acceleration")
        )
        if kind in ("good", "hasty"):
            target = next_leader_speed([*heard, heard[0]], "causal", T)
            own = ((target - speed) / T).clamp(-A_MAX, A_MAX) / A_MAX
            return own + (0.1 / T / A_MAX if kind == "hasty" else 0.0)
        if kind == "bad":
            return torch.ones_like(speed)
        index = torch.arange(speed.shape[-2]).unsqueeze(-1)
        return 2.0 * uniform(td[SEED].unsqueeze(-2), td[STEP].unsqueeze(-2), 77 + index) - 1.0

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        if self.kind != "mixed":
            return td.set(ACTION, self.action(self.kind, td))
        third = td.shape[0] // 3
        parts = [self.action(kind, td)[i * third :][:third] for i, kind in enumerate(ACTORS)]
        return td.set(ACTION, torch.cat(parts))
