"""The training loop: play a batch of episodes, learning as it goes; checkpoint; repeat.

Iteration i is a function of the state before it and of (seed, i) alone: every generator is seeded
anew from these at its start. A checkpoint therefore holds tensors and a counter, and a resumed
training equals one that never stopped, bit for bit.
"""

from __future__ import annotations

import hashlib
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import TransformedEnv

from lcc_rl.agents.ddpg import DDPG
from lcc_rl.config import TrainingConfig, require
from lcc_rl.errors import Diverged, Interrupted, ResultsError
from lcc_rl.policies import GaussianExploration
from lcc_rl.progress import ProgressReporter
from lcc_rl.results.files import read_torch, write_parquet, write_torch

LEARNED_FROM = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
)


def derived_seed(*parts: object) -> int:
    """Return a seed that depends on all parts; distinct purposes get independent streams."""
    digest = hashlib.sha256("/".join(map(str, parts)).encode()).digest()
    return int.from_bytes(digest[:4], "big") >> 1


REPORTED = (("next", "reward"), ("next", "reward_terms"), ("next", "done"), ("next", "terminated"))


class Trainer:
    """Trains an off-policy agent and keeps its record.

    Args:
        agent: the agent.
        env: the training environment, ``[environments]`` episodes side by side.
        settings: length and bookkeeping.
        seed: seed of everything random.
        folder: where training.parquet, timing.parquet, checkpoint.pt and progress.json go.
        identity: hash of the configuration; a checkpoint of another one is refused.

    Raises:
        ConfigError: if the settings contradict each other.
    """

    def __init__(
        self,
        agent: DDPG,
        env: TransformedEnv,
        settings: TrainingConfig,
        seed: int,
        folder: Path,
        identity: str,
    ) -> None:
        batch, self.horizon = env.batch_size[0], env.base_env.horizon
        require(
            settings.episodes >= batch,
            f"training.episodes ({settings.episodes}) must be at least "
            f"training.environments ({batch})",
        )
        require(
            settings.episodes % batch == 0,
            f"training.episodes ({settings.episodes}) must be a multiple of "
            f"training.environments ({batch})",
        )
        require(
            settings.segment >= 1 and self.horizon % settings.segment == 0,
            f"training.segment ({settings.segment}) must divide scenario.horizon ({self.horizon})",
        )
        require(settings.checkpoint_every >= 1, "training.checkpoint_every must be at least 1")
        self.agent, self.env, self.settings = agent, env, settings
        self.seed, self.folder, self.identity = seed, folder, identity
        self.iterations = settings.episodes // batch
        self.iteration, self.updates = 0, 0
        self.rows: list[dict[str, float]] = []
        # Told every row as it appears; see lcc_rl.results.loggers.
        self.on_row: Callable[[dict[str, float]], None] = lambda row: None
        self.times: list[dict[str, float]] = []
        self.exploration = GaussianExploration(0.0).to(env.device or "cpu")
        self.sampler = torch.Generator()
        self.buffer = ReplayBuffer(
            storage=LazyTensorStorage(agent.buffer_size, device=env.device or "cpu"),
            batch_size=agent.batch_size,
            generator=self.sampler,
        )

    # -- the loop ------------------------------------------------------------------------------

    def run(self) -> pd.DataFrame:
        """Train to the end and return the record, one row per iteration.

        Raises:
            Interrupted: on SIGINT or SIGTERM, after the iteration at hand is saved.
            Diverged: if a loss or the reward is not finite.
        """
        title = f"train {self.folder.name}"
        progress = ProgressReporter(
            title, self.iterations, start=self.iteration, folder=self.folder
        )
        collector = self._collector()
        with stop_signal() as stop, progress:
            while self.iteration < self.iterations:
                row = self._iterate(collector)
                self.on_row(row)
                progress.update(
                    self.iteration, {"reward": row["episode_reward"], "loss": row["loss_value"]}
                )
                if stop.is_set():
                    self.save()
                    raise Interrupted(
                        f"stopped after iteration {self.iteration} of {self.iterations}; go on "
                        f"with: python -m lcc_rl.train resume={self.folder}"
                    )
                if self.iteration % self.settings.checkpoint_every == 0:
                    self.save()
        self.save()
        return pd.DataFrame(self.rows)

    def _collector(self) -> Collector:
        policy = TensorDictSequential(self.agent.policy, self.exploration)
        return Collector(
            self.env,
            policy,
            frames_per_batch=self.env.batch_size[0] * self.settings.segment,
            total_frames=-1,
            auto_register_policy_transforms=False,
        )

    def _iterate(self, collector: Collector) -> dict[str, float]:
        """Play one batch of episodes, learning after every segment of them."""
        sigma = self.agent.exploration.sigma(self.iteration / self.iterations)
        self.exploration.sigma.fill_(sigma)
        self.env.set_seed(derived_seed(self.seed, self.iteration, "episodes"))
        self.sampler.manual_seed(derived_seed(self.seed, self.iteration, "replay"))
        collector.reset()
        segments = iter(collector)
        played, losses, spent = [], [], [0.0, 0.0]
        for part in range(self.horizon // self.settings.segment):
            begun = time.perf_counter()
            batch = next(segments)
            self.buffer.extend(batch.select(*LEARNED_FROM).reshape(-1))
            played.append(batch.select(*REPORTED))
            collected = time.perf_counter()
            before = (self.iteration * self.horizon + part * batch.shape[1]) * batch.shape[0]
            losses.append(self._learn(before, batch.numel()))
            spent[0] += collected - begun
            spent[1] += time.perf_counter() - collected
        episodes = torch.cat(played, dim=1)
        self.iteration += 1
        row = {
            "iteration": float(self.iteration),
            "episodes": float(self.iteration * self.env.batch_size[0]),
            "transitions": float(self.iteration * episodes.numel()),
            "updates": float(self.updates),
            "exploration_sigma": sigma,
            **episode_statistics(episodes),
            **{name: sum(loss[name] for loss in losses) / len(losses) for name in losses[0]},
        }
        self._check_finite(row)
        self.rows.append(row)
        times = zip(("iteration", "collect_s", "learn_s"), (row["iteration"], *spent), strict=True)
        self.times.append(dict(times))
        return row

    def _learn(self, before: int, new: int) -> dict[str, float]:
        """Take the updates that are due after ``new`` transitions on top of those ``before``."""
        ratio, ready = self.agent.updates_per_transition, len(self.buffer) >= self.agent.batch_size
        count = int((before + new) * ratio) - int(before * ratio) if ready else 0
        sums = {"loss_actor": torch.zeros(()), "loss_value": torch.zeros(())}
        for _ in range(count):
            losses = self.agent.update(self.buffer.sample())
            sums = {name: total + losses[name] for name, total in sums.items()}
        self.updates += count
        return {name: float(total) / max(count, 1) for name, total in sums.items()}

    def _check_finite(self, row: dict[str, float]) -> None:
        for name, value in row.items():
            if not math.isfinite(value):
                good = self.folder / "checkpoint.pt"
                state = f"the last good state is in {good}" if good.exists() else "nothing is saved"
                raise Diverged(
                    f"{name} became {value} in iteration {self.iteration} of {self.iterations}; "
                    f"{state}. Lower agent.critic_lr or agent.actor_lr"
                )

    # -- state ---------------------------------------------------------------------------------

    def save(self) -> None:
        """Write training.parquet, timing.parquet and checkpoint.pt, each whole or not at all."""
        rows, times = pd.DataFrame(self.rows), pd.DataFrame(self.times)
        metadata = {"lcc_rl.config": self.identity}
        write_torch(
            {
                "identity": self.identity,
                "iteration": self.iteration,
                "updates": self.updates,
                "agent": self.agent.state_dict(),
                "buffer": self.buffer.state_dict(),
                "rows": _columns(rows),
                "times": _columns(times),
            },
            self.folder / "checkpoint.pt",
        )
        write_parquet(rows, self.folder / "training.parquet", metadata)
        write_parquet(times, self.folder / "timing.parquet", metadata)

    def load(self) -> None:
        """Go on from checkpoint.pt.

        Raises:
            ResultsError: if it is missing, damaged or belongs to another configuration.
        """
        path = self.folder / "checkpoint.pt"
        state = read_torch(path)
        if state.get("identity") != self.identity:
            raise ResultsError(
                f"{path}: belongs to another configuration (hash {state.get('identity')}, this "
                f"run has {self.identity}); resume with the settings it was started with"
            )
        self.iteration, self.updates = state["iteration"], state["updates"]
        self.agent.load_state_dict(state["agent"])
        self.buffer.load_state_dict(state["buffer"])
        self.buffer.set_rng(self.sampler)  # loading gives the buffer a generator of its own
        self.rows, self.times = _rows(state["rows"]), _rows(state["times"])


def episode_statistics(batch: TensorDictBase) -> dict[str, float]:
    """Summarise the first episode of every slot of a batch ``[environments, steps]``.

    A collision ends an episode early; what the collector appends after it belongs to another
    episode and is left out.

    Returns:
        Mean sums per episode of the reward and of every term, and the number of collisions.
    """
    done = batch["next", "done"].squeeze(-1).int()
    alive = (done.cumsum(1) - done == 0).unsqueeze(-1)

    def per_episode(entry: Tensor) -> float:
        return float((entry * alive).sum(1).double().mean())

    terms = batch["next", "reward_terms"]
    return {
        "episode_reward": per_episode(batch["next", "reward"]),
        **{f"reward_{name}": per_episode(terms[name]) for name in terms.keys()},  # noqa: SIM118
        "collisions": float((batch["next", "terminated"] & alive).sum()),
    }


@contextmanager
def stop_signal() -> Iterator[threading.Event]:
    """Turn the first SIGINT or SIGTERM into a request to stop; the second acts at once."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    before = {kind: signal.getsignal(kind) for kind in (signal.SIGINT, signal.SIGTERM)}

    def request(number: int, frame: Any) -> None:
        event.set()
        signal.signal(signal.SIGINT, before[signal.SIGINT])
        signal.signal(signal.SIGTERM, before[signal.SIGTERM])

    for kind in before:
        signal.signal(kind, request)
    try:
        yield event
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)


def _columns(frame: pd.DataFrame) -> dict[str, Tensor]:
    return {str(name): torch.tensor(frame[name].to_numpy(float)) for name in frame.columns}


def _rows(columns: dict[str, Tensor]) -> list[dict[str, float]]:
    names = list(columns)
    return [
        dict(zip(names, values, strict=True))
        for values in zip(*(columns[name].tolist() for name in names), strict=True)
    ]
