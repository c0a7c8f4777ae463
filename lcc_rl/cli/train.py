"""``lcc-rl train``: train a variant and evaluate it on held-out windows."""

from __future__ import annotations

import logging

from lcc_rl.cli.entry import entry_point, resumed_folder
from lcc_rl.config import is_sweep
from lcc_rl.config.schemas import TrainConfig

log = logging.getLogger("lcc_rl")


@entry_point("train", "lcc_rl.commands.training")
def main(cfg: TrainConfig) -> None:
    """Train into the run's folder."""
    from lcc_rl.commands.training import complete, run  # loads torch

    folder = resumed_folder(cfg, ("resume", "trust", "logger"))
    (complete if is_sweep() else run)(cfg, folder)
    log.info("results in %s", folder)


if __name__ == "__main__":
    main()
