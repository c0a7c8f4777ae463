"""Our IDM follower beside SUMO's behind the same leader; needs the extra ``sumo``."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
import torch

from lcc_rl.functional.driver_models import simulate_follower
from lcc_rl.functional.idm import IDMConstants

libsumo = pytest.importorskip("libsumo", reason="extra sumo")
sumo = pytest.importorskip("sumo", reason="extra sumo")

STEP, SECONDS, LENGTH = 0.1, 60, 5.0
DESIRED, TIME_GAP = 25.0, 1.4
CONSTANTS = IDMConstants(acceleration=1.2, deceleration=1.6, min_gap=2.0)
ROUTES = """<routes>
  <vType id="idm" carFollowModel="IDM" length="{length}" minGap="{gap}" tau="{tau}"
         accel="{a}" decel="{b}" sigma="0" speedFactor="1" speedDev="0" maxSpeed="{v0}"/>
  <route id="r" edges="e"/>
  <vehicle id="leader" type="idm" route="r" depart="0" departPos="100" departSpeed="12"/>
  <vehicle id="follower" type="idm" route="r" depart="0" departPos="70" departSpeed="12"/>
</routes>"""


def leader_speed() -> torch.Tensor:
    """Return a leader that slows down to a crawl and drives off again, ``[time + 1]`` [m/s]."""
    time = torch.arange(int(SECONDS / STEP) + 1, dtype=torch.float64) * STEP
    return 7.0 + 5.0 * torch.cos(time / 6.0)


def road(folder: Path) -> list[str]:
    """Write a straight road of one lane and its two vehicles; return SUMO's command."""
    (folder / "n.xml").write_text(
        '<nodes><node id="a" x="0" y="0"/><node id="b" x="5000" y="0"/></nodes>'
    )
    (folder / "e.xml").write_text(
        '<edges><edge id="e" from="a" to="b" numLanes="1" speed="60"/></edges>'
    )
    binary = Path(sumo.SUMO_HOME) / "bin" / "netconvert"
    files = [f"--node-files={folder}/n.xml", f"--edge-files={folder}/e.xml"]
    subprocess.run(
        [str(binary), *files, f"--output-file={folder}/net.xml", "--no-warnings"],
        check=True,
        capture_output=True,
        env={**os.environ, "SUMO_HOME": sumo.SUMO_HOME},
    )
    settings = {"a": CONSTANTS.acceleration, "b": CONSTANTS.deceleration, "gap": CONSTANTS.min_gap}
    text = ROUTES.format(length=LENGTH, tau=TIME_GAP, v0=DESIRED, **settings)
    (folder / "r.xml").write_text(text)
    words = ["sumo", "-n", f"{folder}/net.xml", "-r", f"{folder}/r.xml", "--step-length", str(STEP)]
    return [*words, "--step-method.ballistic", "true", "--no-step-log", "true", "--no-warnings"]


def sumo_follower(folder: Path, speeds: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return SUMO's follower speeds and gaps behind a leader with given speeds."""
    libsumo.start(road(folder))
    try:
        libsumo.simulationStep()
        libsumo.vehicle.setSpeedMode("leader", 0)
        driven, gaps = [], []
        for speed in speeds[1:].tolist():
            front = libsumo.vehicle.getPosition("leader")[0]
            gaps.append(front - libsumo.vehicle.getPosition("follower")[0] - LENGTH)
            driven.append(libsumo.vehicle.getSpeed("follower"))
            libsumo.vehicle.setSpeed("leader", speed)
            libsumo.simulationStep()
    finally:
        libsumo.close()
    return torch.tensor(driven, dtype=torch.float64), torch.tensor(gaps, dtype=torch.float64)


def test_the_follower_drives_as_sumos_does(tmp_path) -> None:
    speeds = leader_speed()
    driven, gaps = sumo_follower(tmp_path, speeds)
    own, own_gaps, _ = simulate_follower(
        speeds.view(-1, 1),
        driven[:1],
        gaps[:1],
        torch.tensor(DESIRED),
        torch.tensor(TIME_GAP),
        CONSTANTS,
        STEP,
    )
    # The same law and, with SUMO's ballistic steps, the same rule of integration: rounding only.
    assert (own[:-1, 0] - driven).abs().max() < 1e-6
    assert (own_gaps[:-1, 0] - gaps).abs().max() < 1e-5
    assert driven.max() - driven.min() > 5.0
