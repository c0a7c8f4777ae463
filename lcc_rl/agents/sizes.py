"""How long a training is and how much memory it needs, checked before it starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lcc_rl.config import require
from lcc_rl.schemas import TrainingConfig

# Bytes of an iteration's row in the record: some twenty numbers under their names, twice.
RECORD = 4096
# An entry of a batch exists as the steps, as the batch and as what is learned from.
COPIES = 4
# Temporaries of a step, in moments.
MOMENTS = 12


@dataclass(frozen=True)
class Footprint:
    """Bytes of a training, measured on a step of a small one.

    Args:
        step: of a step of one environment while its segment is learned from.
        reported: of a step of one environment that the record is made from.
        moment: of one environment between two steps.
        fixed: what does not depend on the environments, by the option it is due to.
    """

    step: float
    reported: float
    moment: float
    fixed: dict[str, float]

    def needs(self, settings: TrainingConfig, horizon: int) -> dict[str, float]:
        """Return the bytes of a training by the option that they are due to."""
        count, iterations = settings.environments, settings.episodes // settings.environments
        episode = settings.segment * self.step + horizon * COPIES * self.reported
        own = count * (episode + MOMENTS * self.moment)
        return {
            f"training.environments={count}": own,
            f"training.episodes={settings.episodes}": iterations * RECORD,
            **self.fixed,
        }


def check_length(settings: TrainingConfig, horizon: int) -> None:
    """Check that the length of a training and those of its parts go together.

    Raises:
        ConfigError: if the settings contradict each other.
    """
    episodes, environments = settings.episodes, settings.environments
    require(
        episodes >= environments,
        f"training.episodes ({episodes}) must be at least training.environments ({environments})",
    )
    require(
        episodes % environments == 0,
        f"training.episodes ({episodes}) must be a multiple of "
        f"training.environments ({environments})",
    )
    require(
        horizon % settings.segment == 0,
        f"training.segment ({settings.segment}) must divide scenario.horizon ({horizon})",
    )


def check_window(window: int | None, settings: TrainingConfig) -> None:
    """Check agent.best_window, the episodes whose mean reward rates a policy.

    Raises:
        ConfigError: if it is not a whole number of batches of episodes of the training.
    """
    require(
        window is None or (window % settings.environments == 0 and window <= settings.episodes),
        f"agent.best_window ({window}) must be a multiple of training.environments "
        f"({settings.environments}) and at most training.episodes ({settings.episodes}), or "
        "null: the last policy is kept",
    )


def nbytes(entries: Any) -> int:
    """Return the bytes of tensors."""
    return sum(entry.numel() * entry.element_size() for entry in entries)
