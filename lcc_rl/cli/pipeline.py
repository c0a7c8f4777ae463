"""Entry point: the main job, data to results in one command, ``lcc-rl run``."""

from __future__ import annotations

from hydra.core.hydra_config import HydraConfig

from lcc_rl.cli.entry import entry_point, resumed_folder
from lcc_rl.config.schemas import PipelineConfig
from lcc_rl.runs.console import headlines


@entry_point("pipeline", "lcc_rl.commands.pipeline")
def main(cfg: PipelineConfig) -> None:
    """Run everything into the run's folder, or complete the one given by ``resume``."""
    from lcc_rl.commands.pipeline import run  # loads torch

    folder = resumed_folder(cfg, ("resume", "trust"))
    with headlines():
        run(cfg, folder, list(HydraConfig.get().overrides.task))


if __name__ == "__main__":
    main()
