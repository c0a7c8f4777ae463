"""``lcc-rl run``: the main job, from data to results."""

from __future__ import annotations

from hydra.core.hydra_config import HydraConfig

from lcc_rl.cli.entry import entry_point, resumed_folder
from lcc_rl.config import top_key
from lcc_rl.config.schemas import PipelineConfig
from lcc_rl.runs.output import headlines


@entry_point("pipeline", "lcc_rl.commands.pipeline")
def main(cfg: PipelineConfig) -> None:
    """Run the job into its folder, or complete that of ``resume``."""
    from lcc_rl.commands.pipeline import run  # loads torch

    folder = resumed_folder(cfg, ("resume", "trust"))
    typed, chosen = HydraConfig.get().overrides.task, HydraConfig.get().runtime.choices
    own = [] if any(top_key(item) == "experiment" for item in typed) else ["experiment"]
    with headlines():  # the parts are composed from the overrides
        run(cfg, folder, [*(f"{key}={chosen[key]}" for key in own), *typed])


if __name__ == "__main__":
    main()
