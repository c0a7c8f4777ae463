"""``lcc-rl calibrate``: calibrate drivers from trajectories."""

from __future__ import annotations

from lcc_rl.cli.entry import entry_point, run_folder
from lcc_rl.config.schemas import CalibrateConfig


@entry_point("calibrate", "lcc_rl.commands.calibration")
def main(cfg: CalibrateConfig) -> None:
    """Calibrate and write into the run's folder."""
    from lcc_rl.commands.calibration import run  # loads torch

    run(cfg, run_folder())


if __name__ == "__main__":
    main()
