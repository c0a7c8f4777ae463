"""Entry point: the main job, data to results in one command, ``lcc-rl run``."""

from __future__ import annotations

from pathlib import Path

from hydra.core.hydra_config import HydraConfig

from lcc_rl.cli.entry import entry_point, root_key, run_folder
from lcc_rl.config import load
from lcc_rl.config.schemas import PipelineConfig
from lcc_rl.errors import ConfigError
from lcc_rl.runs.console import headlines, tell
from lcc_rl.version import __version__


@entry_point("pipeline", "lcc_rl.commands.pipeline")
def main(cfg: PipelineConfig) -> None:
    """Run everything into the run's folder, or complete the one given by ``resume``."""
    from lcc_rl.commands.pipeline import OVERRIDES, run, stored_overrides  # loads torch
    from lcc_rl.results.runs import check_folder, save_config

    overrides = list(HydraConfig.get().overrides.task)
    folder = run_folder()
    if cfg.resume is not None:
        folder = Path(cfg.resume)
        others = [item for item in overrides if root_key(item) not in ("resume", "trust")]
        if others:
            raise ConfigError(
                "a resumed job keeps the settings it was started with; remove " + " ".join(others)
            )
        if not (folder / OVERRIDES).is_file():
            raise ConfigError(f"{folder}: not the folder of a pipeline: it has no {OVERRIDES}")
        trust = list(cfg.trust)
        overrides = stored_overrides(folder / OVERRIDES, trust)
        cfg = load("pipeline", overrides)
        cfg.trust = trust
    else:
        check_folder(cfg, folder)
    save_config(cfg, folder)
    with headlines():
        tell(f"lcc_rl {__version__}: data, drivers, policies, results into {folder}")
        run(cfg, folder, overrides)


if __name__ == "__main__":
    main()
