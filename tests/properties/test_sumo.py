"""Our IDM follower beside SUMO's behind the same leader; needs the extra ``sumo``."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from commands import run_command
from scipy.integrate import solve_ivp

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


def test_both_are_as_near_an_exact_solution_as_the_page_says() -> None:
    """The row of docs/elsewhere.md; SUMO's is the same by the test above."""
    first = [20.0, 12.0]
    time = np.arange(0.0, SECONDS + STEP / 2, STEP)

    def law(now: float, state: np.ndarray) -> list[float]:
        gap, speed = state
        ahead = 7.0 + 5.0 * np.cos(now / 6.0)
        wanted = 2.0 + max(0.0, speed * (1.4 + (speed - ahead) / (2.0 * np.sqrt(1.2 * 1.6))))
        return [ahead - speed, 1.2 * (1.0 - (speed / 25.0) ** 4 - (wanted / gap) ** 2)]

    exact = solve_ivp(law, (0.0, SECONDS), first, "DOP853", time, rtol=1e-10, atol=1e-10).y
    own, gaps, _ = simulate_follower(
        leader_speed().view(-1, 1),
        torch.tensor(first[1:], dtype=torch.float64),
        torch.tensor(first[:1], dtype=torch.float64),
        torch.tensor(DESIRED),
        torch.tensor(TIME_GAP),
        CONSTANTS,
        STEP,
    )
    assert np.abs(own[:, 0].numpy() - exact[1]).max() == pytest.approx(0.011, abs=5e-4)
    assert np.abs(gaps[:, 0].numpy() - exact[0]).max() == pytest.approx(0.05, abs=5e-3)


DRIVERS = {car: (0.6 + 0.2 * car, 20.0 + 2.0 * car) for car in range(2, 8)}  # T, v0; 1 leads


def test_drivers_of_an_fcd_output_are_calibrated_to_their_constants(tmp_path) -> None:
    """By the options of docs/elsewhere.md and the columns of docs/data.md."""
    words = road(tmp_path)
    kinds = "".join(
        f'<vType id="t{car}" carFollowModel="IDM" tau="{gap}" maxSpeed="{top}" accel="1.2" '
        f'decel="1.6" minGap="2" speedFactor="1" speedDev="0" length="5"/>'
        for car, (gap, top) in DRIVERS.items()
    )
    cars = "".join(
        f'<vehicle id="{car}" type="t{max(car, 2)}" route="r" depart="0" '
        f'departPos="{500 - 35 * car}" departSpeed="15"/>'
        for car in range(1, 8)
    )
    route = '<route id="r" edges="e"/>'
    (tmp_path / "r.xml").write_text(f"<routes>{kinds}{route}{cars}</routes>")
    output = tmp_path / "fcd.csv"
    fcd = ["--fcd-output", str(output), "--fcd-output.max-leader-distance", "150"]
    libsumo.start([*words, *fcd, "--precision", "6", "--time-to-teleport", "-1"])
    libsumo.simulationStep()
    libsumo.vehicle.setSpeedMode("1", 0)
    for time in np.arange(1500) * STEP:
        libsumo.vehicle.setSpeed("1", 13.0 + 7.0 * np.sin(time / 9.0))
        libsumo.simulationStep()
    libsumo.close()
    columns = ["vehicle=vehicle_id", "time=timestep_time", "speed=vehicle_speed"]
    columns += ["leader=vehicle_leaderID", "gap=vehicle_leaderGap"]
    known = [f"calibration.constants.{x}" for x in ("acceleration=1.2", "deceleration=1.6")]
    named = [f"data.columns.{column}" for column in columns]
    settings = ["data=table", f"data.path={output}", *named, *known, f"hydra.run.dir={tmp_path}/c"]
    run_command("calibrate", *settings, cwd=tmp_path, check=True)
    for row in pd.read_parquet(tmp_path / "c" / "drivers.parquet").itertuples():
        gap, top = DRIVERS[int(row.follower_id)]
        assert (row.time_gap_s, row.desired_speed_mps) == pytest.approx((gap, top), abs=0.02)
