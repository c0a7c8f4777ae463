"""How long a training and its parts are, checked before it starts."""

from __future__ import annotations

from lcc_rl.errors import require
from lcc_rl.schemas import TrainingConfig


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
