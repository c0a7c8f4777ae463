"""Entry point: train a variant and evaluate it on held-out profiles, ``python -m lcc_rl.train``."""

from __future__ import annotations

import logging
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from lcc_rl.config import is_sweep
from lcc_rl.errors import ConfigError
from lcc_rl.runs.cli import entry_point, root_key, run_folder

log = logging.getLogger("lcc_rl")


@entry_point("train", "lcc_rl.commands.training")
def main(cfg: DictConfig) -> float | list[float]:
    """Train into the run's folder; return the objective to a sweeper that optimises."""
    from lcc_rl.commands.training import complete, objective, run  # loads torch

    own = ("resume", "trust", "logger")
    typed = HydraConfig.get().overrides.task
    others = [item for item in typed if root_key(item) not in own]
    if cfg.resume is not None and others:
        raise ConfigError(
            f"a resumed run keeps the settings it was started with; remove {' '.join(others)}"
        )
    folder = Path(cfg.resume) if cfg.resume is not None else run_folder()
    episodes = complete(cfg, folder) if is_sweep() else run(cfg, folder)
    log.info("results in %s", folder)
    return objective(cfg, episodes)


if __name__ == "__main__":
    main()
