"""What one evaluation saves by each energy model: python tools/energy_models.py <folder>

Prices the speeds of steps.parquet (``evaluation.sample_episodes=…``) by the paper's motor, an
electric car and CIRCLES' vehicles, and where they are installed by FASTSim 3 (Ford Fusion 2012) and
SUMO's HBEFA4 and PHEMlight5. A last line names models that disagree on a saving.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from lcc_rl.cli.guard import main_guard
from lcc_rl.energy import CirclesFuel, ElectricCar, EnergyModel, PaperMotor
from lcc_rl.energy.fuel import coefficients
from lcc_rl.errors import DataError, require
from lcc_rl.io.files import read_parquet
from lcc_rl.results.intervals import Estimate, saving
from lcc_rl.results.render import markdown_table, saved_text
from lcc_rl.results.runs import STEPS
from lcc_rl.runs.arguments import Arguments

Speeds = NDArray[np.float64]  # [rows, time] [m/s]
Price = Callable[[Speeds, float], NDArray[np.float64]]  # energy less the kinetic gain, [rows] [J]
PETROL = CirclesFuel()  # its heating value and worth of kinetic energy, for models of others
RUN_UP = 1.0  # acceleration from standstill, which FASTSim needs before a record [m/s²]
SUMO_CLASSES = ("HBEFA4/PC_petrol_Euro-4", "PHEMlight5/PC_EU4_G")


def own(model: EnergyModel) -> Price:
    """Return the price of a model of this package."""

    def price(speeds: Speeds, step: float) -> NDArray[np.float64]:
        speed = torch.from_numpy(speeds)
        motion = speed[:, :-1], speed.diff(dim=1) / step
        drawn = (model.power(*motion) + model.unpaid(*motion)).sum(1) * step
        gain = model.stored_energy(speed[:, -1]) - model.stored_energy(speed[:, 0])
        return (drawn - gain).numpy()

    return price


def _of_fuel(joules: NDArray[np.float64], speeds: Speeds) -> NDArray[np.float64]:
    ends = torch.from_numpy(speeds[:, [0, -1]])
    return joules - PETROL.stored_energy(ends).diff(dim=1)[:, 0].numpy()


def by_sumo(name: str) -> Price:
    """Return the price of one of SUMO's emission classes, which need speed and acceleration."""

    def price(speeds: Speeds, step: float) -> NDArray[np.float64]:
        home = Path(import_module("sumo").SUMO_HOME)
        rows = np.stack([speeds[:, :-1], np.diff(speeds) / step]).reshape(2, -1)
        with tempfile.TemporaryDirectory() as folder:
            given, found = Path(folder) / "given", Path(folder) / "found"
            lines = (f"{time};{v:.6f};{a:.6f};0" for time, (v, a) in enumerate(rows.T))
            given.write_text("\n".join(lines) + "\n", encoding="utf-8")
            binary = str(home / "bin" / "emissionsDrivingCycle")
            words = [binary, "-t", str(given), "-o", str(found), "-e", name]
            environment = {**os.environ, "SUMO_HOME": str(home)}
            done = subprocess.run(words, env=environment, capture_output=True, text=True)
            require(done.returncode == 0, f"SUMO, {name}: {done.stderr.strip()}")
            grams = pd.read_csv(found, sep=";", header=None)[9].to_numpy() / 1e3  # per second
        joules = grams.reshape(len(speeds), -1).sum(1) * step * PETROL.heating_value
        return _of_fuel(joules, speeds)

    return price


def by_fastsim(speeds: Speeds, step: float) -> NDArray[np.float64]:
    """Return the price by FASTSim 3; a record is driven after a run-up, whose fuel does not count.

    Where its vehicle cannot follow the record, it drives as fast as it can.
    """
    fastsim = import_module("fastsim")
    settings = {**fastsim.SimParams.default().to_dict(), "trace_miss_opts": "Allow"}
    joules = np.empty(len(speeds))
    for row, record in enumerate(speeds):
        up = np.arange(0.0, record[0], RUN_UP * step)
        whole = np.concatenate([up, record])
        times = {"time_seconds": (step * np.arange(len(whole))).tolist()}
        level = {"name": str(row), "grade": [0.0] * len(whole)}
        cycle = {**level, **times, "speed_meters_per_second": whole.tolist()}
        vehicle = fastsim.Vehicle.from_resource("2012_Ford_Fusion.yaml")
        vehicle.set_save_interval(1)
        road, settled = fastsim.Cycle.from_dict(cycle), fastsim.SimParams.from_dict(settings)
        drive = fastsim.SimDrive(vehicle, road, settled)
        drive.walk()
        burnt = drive.to_dict()["veh"]["pt_type"]["Conv"]["fc"]["history"]["energy_fuel_joules"]
        joules[row] = burnt[-1] - burnt[len(up)]
    return _of_fuel(joules, speeds)


def prices() -> Iterator[tuple[str, Price]]:
    """Yield name and price of each model that is installed."""
    yield "alcc", own(PaperMotor())
    yield "electric", own(ElectricCar())
    for vehicle in coefficients():
        yield vehicle, own(CirclesFuel(vehicle=vehicle))
    others: dict[str, dict[str, Price]] = {"fastsim": {"FASTSim 3": by_fastsim}}
    others["sumo"] = {name: by_sumo(name) for name in SUMO_CLASSES}
    for module, found in others.items():
        try:
            import_module(module)
        except ImportError:
            print(f"{module} is not installed: without {' and '.join(found)}", file=sys.stderr)
        else:
            yield from found.items()


def motions(steps: pd.DataFrame) -> tuple[dict[str, Speeds], list[str], float]:
    """Return speeds of whole episodes by strategy, ``[episodes, vehicles, time]``, and their step.

    Strategies with a collision or fewer vehicles are left out. The names are of the profiles.
    """
    cars = [name for name in map(str, steps) if re.fullmatch(r"(cav|hdv)\d*_speed", name)]
    keys = ["training_seed", "profile", "driver_id"]
    given = {"strategy", "time_s", *keys} <= {*steps} and cars
    require(given, f"{STEPS} is not of a string behind a leader or on a ring, but of a platoon")
    groups = {
        str(name): [frame for _, frame in rows.groupby(keys, dropna=False, sort=True)]
        for name, rows in steps.groupby("strategy")
    }
    length = max(len(frame) for frames in groups.values() for frame in frames)
    found = {
        name: np.stack([frame[cars].to_numpy(np.float64).T for frame in frames])
        for name, frames in groups.items()
        if all(len(frame) == length and frame[cars].notna().all(axis=None) for frame in frames)
    }
    require(found, f"{STEPS}: every strategy has an episode with a collision; expected one without")
    profiles = [frame["profile"].iloc[0] for frame in groups[next(iter(found))]]
    return found, profiles, float(steps["time_s"].diff().median())


def savings(folder: Path, baseline: str) -> dict[str, dict[str, Estimate]]:
    """Return the saving of each strategy by each model against a baseline in the same episodes."""
    if not (folder / STEPS).is_file():
        raise DataError(f"{folder}: no {STEPS}: evaluate with evaluation.sample_episodes=24")
    driven, profiles, step = motions(read_parquet(folder / STEPS))
    require(baseline in driven, f"{baseline} is not in {folder}: it has {', '.join(driven)}")
    shape = driven[baseline].shape
    driven = {name: speeds for name, speeds in driven.items() if speeds.shape == shape}
    drives = [name.split("/")[0] for name in profiles]
    table: dict[str, dict[str, Estimate]] = {}
    for model, price in prices():
        per_km = {}
        for name, speeds in driven.items():
            joules = price(speeds.reshape(-1, shape[-1]), step).reshape(shape[:2]).sum(1)
            way = step * (speeds.sum((1, 2)) - 0.5 * speeds[..., [0, -1]].sum((1, 2)))
            per_km[name] = (joules / way)[:, None]
        table[model] = {
            name: saving(values, per_km[baseline], drives=drives)
            for name, values in per_km.items()
            if name != baseline
        }
    return table


def disagreements(table: dict[str, dict[str, Estimate]]) -> list[str]:
    """Return a line for each strategy whose saving differs in sign or by more than two times."""
    lines = []
    for name in next(iter(table.values())):
        worth = {model: found[name].value for model, found in table.items()}
        least, most = min(worth, key=worth.__getitem__), max(worth, key=worth.__getitem__)
        if worth[least] < 0.0 < worth[most] or abs(worth[most]) > 2.0 * abs(worth[least]):
            ends = f"{least} {100 * worth[least]:+.1f} %, {most} {100 * worth[most]:+.1f} %"
            lines.append(f"the model decides the saving of {name}: {ends}")
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the savings [%] as Markdown, a row per model."""
    parser = Arguments(prog="tools/energy_models.py", description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of an evaluation with steps.parquet")
    parser.add_argument("baseline", nargs="?", default="human", help="strategy to compare with")
    table = savings(**vars(parser.parse_args(arguments)))
    lines = [
        [model, *(saved_text(*x.percent) for x in row.values())] for model, row in table.items()
    ]
    print(markdown_table(["", *next(iter(table.values()))], lines))
    print(*disagreements(table), sep="\n")


if __name__ == "__main__":
    main_guard(main)()
