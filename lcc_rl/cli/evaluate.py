"""``lcc-rl evaluate``: evaluate a policy and baselines."""

from __future__ import annotations

import logging

from hydra.core.hydra_config import HydraConfig

from lcc_rl.cli.entry import entry_point, resumed_folder
from lcc_rl.config import is_sweep
from lcc_rl.config.schemas import EvaluateConfig

log = logging.getLogger("lcc_rl")


@entry_point("evaluate", "lcc_rl.commands.evaluation")
def main(cfg: EvaluateConfig) -> None:
    """Evaluate into the run's folder."""
    from lcc_rl.commands.evaluation import complete, run  # loads torch

    folder = resumed_folder(cfg, ("resume", "trust"))
    work = complete if is_sweep() else run
    work(cfg, folder, typed=HydraConfig.get().overrides.task)
    log.info("results in %s", folder)


if __name__ == "__main__":
    main()
