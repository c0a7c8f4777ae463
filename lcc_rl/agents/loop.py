"""Base of training loops: record, checkpoints, stopping and resuming.

Iteration i of a training is a function of the state before it and of (seed, i): every generator is
seeded from these at its start. A checkpoint therefore contains tensors and a counter, and a resumed
training equals an uninterrupted one bit for bit.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, TypeVar

import pandas as pd
import torch
from pydantic import AfterValidator
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from lcc_rl.agents.agent import Agent
from lcc_rl.agents.checks import check_learner, check_restored, check_state
from lcc_rl.agents.vectors import denormals_flushed
from lcc_rl.config.schemas import TrainingConfig
from lcc_rl.errors import ConfigError, Diverged, Interrupted, ResultsError, require
from lcc_rl.io.files import IDENTITY, write_parquet
from lcc_rl.io.tensors import check_like, write_torch
from lcc_rl.pieces.base import REWARD
from lcc_rl.pieces.rewards import TERMS
from lcc_rl.results.policies import read_checked
from lcc_rl.results.runs import RECORD
from lcc_rl.runs.interrupts import stop_signal
from lcc_rl.runs.progress import ProgressReporter
from lcc_rl.runs.states import CHECKPOINT
from lcc_rl.settings import Settings, Whole

log = logging.getLogger("lcc_rl")

LAST_TENTH = 10  # iterations from which the last episodes of a training, a tenth, are looked at
# Entries from which the record of an iteration is computed.
REPORTED = tuple(("next", *key) for key in (REWARD, TERMS, ("done",), ("terminated",)))

AgentT = TypeVar("AgentT", bound=Agent)


def check_columns(columns: dict[str, Any]) -> dict[str, Any]:
    """Check that the columns of a record are numbers in double precision."""
    for name, value in columns.items():
        if not isinstance(value, Tensor) or value.dtype != torch.float64 or value.ndim != 1:
            raise ValueError(f"column {name!r} is no list of numbers in double precision")
    return columns


RecordColumns = Annotated[dict[str, Any], AfterValidator(check_columns)]


class Checkpoint(Settings):
    """Contents of a checkpoint."""

    identity: str
    iteration: Whole
    updates: Whole
    agent: dict[str, Any]
    rows: RecordColumns  # the record, an entry per iteration
    times: RecordColumns
    memory: dict[str, Any]

    def validate(self) -> None:
        lengths = {len(column) for column in (*self.rows.values(), *self.times.values())}
        if not {*lengths, *([] if self.rows else [0])} <= {self.iteration}:
            raise ConfigError(f"iteration {self.iteration}, but rows of {sorted(lengths)}")


class TrainingLoop(ABC, Generic[AgentT]):
    """Runs iterations to the end and keeps their record; a subclass defines the iteration.

    Args:
        env: the training environment, ``[environments]`` parallel episodes.
        settings: settings ``training``.
        seed: seed of all random numbers.
        folder: folder of training.parquet, timing.parquet, checkpoint.pt and progress.json.
        identity: hash of the configuration; a checkpoint with another hash is refused.
    """

    advice: ClassVar[str] = "Lower its learning rate"  # remedy if the training diverges
    watched: ClassVar[str] = "loss_value"  # the entry of the record shown as the loss

    def __init__(
        self,
        agent: AgentT,
        env: TransformedEnv,
        settings: TrainingConfig,
        seed: int,
        folder: Path,
        identity: str,
    ) -> None:
        self.horizon = env.base_env.horizon
        self.keep_every = settings.keep_every
        self.agent, self.env, self.settings = agent, env, settings
        self.seed, self.folder, self.identity = seed, folder, identity
        self.iterations = settings.episodes // settings.environments
        self.iteration, self.updates = 0, 0
        self.rows: list[dict[str, float]] = []
        # Score, iteration and weights of the best policy, if a subclass keeps one.
        self.best: dict[str, Any] | None = None
        self.times: list[dict[str, float]] = []
        # Called with every row (lcc_rl.runs.loggers), and with iterations whose policy is kept.
        self.on_row: Callable[[dict[str, float]], None] = lambda row: None
        self.on_keep: Callable[[int], None] = lambda iteration: None
        check_state(agent.policy, agent.state_dict())
        self.trained = [*map(id, agent.policy.parameters())]
        self._prepare()

    def _prepare(self) -> None:
        """Build further parts of a subclass; called at the end of the constructor."""

    @abstractmethod
    def source(self) -> Any:
        """Return the argument of :meth:`iterate`, what plays episodes; built once per run."""

    @abstractmethod
    def iterate(self, source: Any) -> dict[str, float]:
        """Play and learn from one batch of episodes; return the result of :meth:`record`."""

    def run(self) -> pd.DataFrame:
        """Train to the end and return the record, one row per iteration.

        Raises:
            Interrupted: on SIGINT or SIGTERM, after the present iteration is saved.
            Diverged: if a loss, a weight or an entry of transitions is not finite.
        """
        title = f"train {self.folder.name}"
        progress = ProgressReporter(
            title, self.iterations, start=self.iteration, folder=self.folder
        )
        source = self.source()
        with stop_signal() as stop, progress:
            while self.iteration < self.iterations:
                row = self._numbers(source)
                self.on_row(row)
                if self.keep_every is not None and self.iteration % self.keep_every == 0:
                    self.on_keep(self.iteration)
                progress.update(
                    self.iteration, {"reward": row["episode_reward"], "loss": row[self.watched]}
                )
                if stop.is_set():
                    self.save()
                    raise Interrupted(
                        f"stopped after iteration {self.iteration} of {self.iterations}; resume "
                        f"with: lcc-rl train resume={self.folder}"
                    )
                if self.iteration % self.settings.checkpoint_every == 0:
                    self.save()
        self.save()
        record = pd.DataFrame(self.rows)
        if warning := still_colliding(record):
            log.warning(warning)
        return record

    def _numbers(self, source: Any) -> dict[str, float]:
        """Run an iteration; an error names it and the file of the last valid state."""
        good = self.folder / CHECKPOINT
        where = f"in iteration {self.iteration + 1} of {self.iterations}"
        try:
            check_learner(self.agent.policy, {}, self.advice)
            with denormals_flushed():
                return self.iterate(source)
        except Diverged as error:
            state = f"the last good state is in {good}" if good.exists() else "nothing is saved"
            raise Diverged(f"{error.what} {where}; {state}", error.advice) from error

    def record(
        self,
        played: Sequence[TensorDictBase],
        losses: Sequence[Mapping[str, Any]],
        spent: Sequence[float],
        transitions: int,
        begin: Mapping[str, float],
        end: Mapping[str, float] | None = None,
    ) -> dict[str, float]:
        """End an iteration: append it to the record and return its row.

        Args:
            played: the entries :data:`REPORTED` of each segment, ``[environments, steps]``.
            losses: losses of each segment; their means are recorded.
            spent: time of playing episodes and time of learning [s].
            transitions: number of transitions of the iteration.
            begin, end: further columns, before and after those of episodes and losses.

        Raises:
            Diverged: if a value is not finite.
        """
        self.iteration += 1
        row = {
            "iteration": float(self.iteration),
            "episodes": float(self.iteration * self.env.batch_size[0]),
            "transitions": float(self.iteration * transitions),
            "updates": float(self.updates),
            **begin,
            **episode_statistics(torch.cat(list(played), dim=1)),
            **(end or {}),
        }
        learned = mean_of(losses)
        taken = ", ".join(row.keys() & learned.keys())
        require(not taken, f"learn returns {taken}, a column of the record: choose another name")
        row |= learned
        check_learner(self.agent.policy, row, self.advice)
        same = [*map(id, self.agent.policy.parameters())] == self.trained
        require(same, "the training replaced agent.policy: change its weights in place")
        self.rows.append(row)
        times = dict(zip(("collect_s", "learn_s"), spent, strict=True))
        self.times.append({"iteration": row["iteration"], **times})
        return row

    # -- state ---------------------------------------------------------------------------------

    def _memory(self) -> dict[str, Any]:
        """Return further parts of a checkpoint besides the agent and the record."""
        return {}

    def _remember(self, memory: dict[str, Any]) -> None:
        """Restore the result of :meth:`_memory`."""
        assert not memory, "a loop that keeps a memory restores it"

    def save(self) -> None:
        """Write training.parquet, timing.parquet and checkpoint.pt, each whole or not at all."""
        rows, times = pd.DataFrame(self.rows), pd.DataFrame(self.times)
        metadata = {IDENTITY: self.identity}
        write_torch(
            {
                "identity": self.identity,
                "iteration": self.iteration,
                "updates": self.updates,
                "agent": self.agent.state_dict(),
                "rows": _columns(rows),
                "times": _columns(times),
                "memory": self._memory(),
            },
            self.folder / CHECKPOINT,
        )
        write_parquet(rows, self.folder / RECORD, metadata)
        write_parquet(times, self.folder / "timing.parquet", metadata)

    def load(self) -> None:
        """Resume from checkpoint.pt.

        Raises:
            ResultsError: if it is missing, damaged or belongs to another configuration.
        """
        path = self.folder / CHECKPOINT
        found = read_checked(path, Checkpoint, "checkpoint")
        if found.identity != self.identity:
            raise ResultsError(
                f"{path}: belongs to another configuration (hash {found.identity}, not "
                f"{self.identity})"
            )
        try:
            if found.iteration > self.iterations:
                raise ValueError(f"iteration {found.iteration} of {self.iterations}")
            check_like(found.agent, self.agent.state_dict(), "agent")
            self.agent.load_state_dict(found.agent)
            check_restored(found.agent, self.agent.state_dict())
            self._remember(found.memory)
        except Exception as error:  # parts that do not fit raise many kinds of errors
            raise ResultsError(f"{path}: does not fit this training: {error!r}") from error
        self.iteration, self.updates = found.iteration, found.updates
        self.rows, self.times = _rows(found.rows), _rows(found.times)


def still_colliding(record: pd.DataFrame) -> str:
    """Return a warning if more than 1 % of the episodes at the end of a training collided."""
    if len(record) < LAST_TENTH:
        return ""
    late = record.iloc[-(len(record) // LAST_TENTH) :]
    share = 100.0 * late["collisions"].sum() / (late["episodes"] / late["iteration"]).sum()
    text = "of the last episodes ended in a collision, which may cost less than the driving that "
    remedy = "it ends: raise reward.terms.collision.weight, or train behind a filter"
    return f"{share:.2g} % {text}{remedy}" if share > 1.0 else ""


def episode_statistics(batch: TensorDictBase) -> dict[str, float]:
    """Summarise the first episode of every slot of a batch ``[environments, steps]``.

    A collision ends an episode early; the steps after it belong to another episode and are left
    out. Rewards are summed over automated vehicles.

    Returns:
        Mean sum per episode of the reward and of every term, and the number of collisions.
    """
    done = batch["next", "done"].squeeze(-1).int()
    alive = (done.cumsum(1) - done == 0).unsqueeze(-1)

    def per_episode(entry: Tensor) -> float:
        entry = entry.flatten(2).sum(-1, keepdim=True)
        return float((entry * alive).sum(1).double().mean())

    terms = batch.get(("next", *TERMS))
    return {
        "episode_reward": per_episode(batch.get(("next", *REWARD))),
        **{f"reward_{name}": per_episode(terms[name]) for name in terms.keys()},  # noqa: SIM118
        "collisions": float((batch["next", "terminated"] & alive).sum()),
    }


def mean_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the mean of each entry.

    Raises:
        ConfigError: if the rows have different entries.
    """
    same = all(row.keys() == rows[0].keys() for row in rows)
    require(same, "learn must return the same names after every segment")
    return {name: sum(float(row[name]) for row in rows) / len(rows) for name in rows[0]}


def _columns(frame: pd.DataFrame) -> dict[str, Tensor]:
    return {str(name): torch.tensor(frame[name].to_numpy(float)) for name in frame.columns}


def _rows(columns: dict[str, Tensor]) -> list[dict[str, float]]:
    names = list(columns)
    return [
        dict(zip(names, values, strict=True))
        for values in zip(*(columns[name].tolist() for name in names), strict=True)
    ]
