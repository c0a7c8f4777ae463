"""Our energy models beside those of SUMO on drive cycles: python tools/compare_sumo_energy.py

One car per model drives UDDS, HWFET and US06 in SUMO, in steps of 0.1 s, stands for 10 s and pulls
away to 15 m/s in 10 s. SUMO's electric model
"Energy" gets mass, road load, auxiliaries and efficiencies of our electric cars; its other models
are cars of their own. Rows go to --reference.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import torch
from omegaconf import OmegaConf
from sumo_ring import write_network
from torch import Tensor

from lcc_rl.data.profiles import resample
from lcc_rl.data.speed_records import read_speed_record
from lcc_rl.energy import CirclesFuel, EnergyModel
from lcc_rl.interfaces.sumo import load_sumo
from lcc_rl.io.files import write_parquet
from lcc_rl.nodes import build
from lcc_rl.runs.cli import main_guard

STEP, AROUND, SPACE = 0.1, 80_000.0, 20.0  # [s]; of a ring without bends to speak of, [m]
CYCLES = ("udds", "hwfet", "us06")
MOMENTS = {"standing": torch.zeros(101), "to 15 m/s": torch.linspace(0.0, 15.0, 101)}
ROOT = Path(__file__).resolve().parents[1]
FUEL = {"compact": "Compact", "midsize": "midBase"}
ELECTRIC = ("electric", "bolt")
UNLIMITED = {"regeneration_limit": 1e9, "fade_speed": 1e-6}
CLASSES = {  # of SUMO, emission classes of cars by name
    "HBEFA4 petrol Euro 6ab": "HBEFA4/PC_petrol_Euro-6ab",
    "HBEFA3 petrol Euro 6": "HBEFA3/PC_G_EU6",
    "PHEMlight petrol Euro 4": "PHEMlight/PC_G_EU4",
}
SHIPPED = {"MMPEVEM VW ID.3": "VW_ID3", "MMPEVEM VW e-Up": "VW_eUp"}


def settings(name: str) -> dict[str, Any]:
    """Return the settings of an energy model of ours."""
    found: Any = OmegaConf.to_container(OmegaConf.load(ROOT / "conf" / "energy" / f"{name}.yaml"))
    return dict(found)


def own_models() -> dict[str, EnergyModel]:
    """Return our models, the electric ones also without the limits of recuperation."""
    fuel = settings("fuel")
    models = {name: build(fuel | {"vehicle": kind}, name) for name, kind in FUEL.items()}
    models |= {name: build(settings(name), name) for name in ELECTRIC}
    for name in ELECTRIC:
        models[f"{name}, unlimited"] = build(settings(name) | UNLIMITED, name)
    return models


def parameters(car: Mapping[str, Any]) -> dict[str, str]:
    """Return an electric car of ours as parameters of SUMO's model "Energy"."""
    of_sumo = {
        "frontSurfaceArea": car["area"],
        "airDragCoefficient": car["drag"],
        "rotatingMass": car["mass"] * (car["rotating_mass"] - 1.0),
        "radialDragCoefficient": 0.0,
        "rollDragCoefficient": car["rolling"],
        "constantPowerIntake": car["auxiliary"],
        "propulsionEfficiency": car["efficiency"],
        "recuperationEfficiency": car["efficiency"],
    }
    return {name: f"{value}" for name, value in of_sumo.items()}


def write_types(path: Path) -> dict[str, str]:
    """Write a vehicle of every model; return their models by id."""
    root = ElementTree.Element("routes")
    names = {}
    for name in ELECTRIC:
        car = settings(name)
        given = {"id": name, "emissionClass": "Energy/unknown", "mass": f"{car['mass']}"}
        kind = ElementTree.SubElement(root, "vType", given)
        for key, value in parameters(car).items():
            ElementTree.SubElement(kind, "param", key=key, value=value)
        names[name] = f"SUMO Energy, {name}"
    for number, (name, emission) in enumerate(CLASSES.items()):
        ElementTree.SubElement(root, "vType", id=f"c{number}", emissionClass=emission)
        names[f"c{number}"] = f"SUMO {name}"
    names |= {kind: f"SUMO {name}" for name, kind in SHIPPED.items()}
    for place, vehicle_type in enumerate(names):
        where = {"departPos": f"{100.0 + SPACE * place}", "depart": "0", "departSpeed": "0"}
        vehicle = ElementTree.SubElement(
            root, "vehicle", where | {"id": vehicle_type, "type": vehicle_type}
        )
        ElementTree.SubElement(vehicle, "param", key="has.battery.device", value="true")
        ElementTree.SubElement(vehicle, "route", edges="east west")
    ElementTree.ElementTree(root).write(path)
    return names


def driven_in_sumo(speed: Tensor, folder: Path) -> dict[str, tuple[float, float]]:
    """Drive a trace in SUMO; return electricity [Wh] and fuel [g] by model."""
    libsumo = load_sumo()
    write_network(folder / "road.net.xml", AROUND)
    names = write_types(folder / "cars.rou.xml")
    data = Path(os.environ["SUMO_HOME"]) / "data" / "emissions"
    types = [str(data / "MMPEVEM" / f"{kind}.xml") for kind in SHIPPED.values()]
    words = ["sumo", "-n", f"{folder}/road.net.xml", "-r", f"{folder}/cars.rou.xml"]
    words += ["-a", ",".join(types), "--phemlight-path", str(data / "PHEMlight")]
    words += ["--step-length", str(STEP), "--step-method.ballistic", "true", "--no-step-log"]
    libsumo.start([*words, "--no-warnings", "true"])
    used = dict.fromkeys(names, (0.0, 0.0))
    try:
        libsumo.simulationStep()
        for kind in names:
            libsumo.vehicle.setSpeedMode(kind, 0)
        for reached in speed[1:].tolist():
            for kind in names:
                libsumo.vehicle.setSpeed(kind, reached)
            libsumo.simulationStep()
            for kind, (electricity, fuel) in used.items():
                assert abs(libsumo.vehicle.getSpeed(kind) - reached) < 1e-6
                electricity += libsumo.vehicle.getElectricityConsumption(kind) * STEP
                fuel += libsumo.vehicle.getFuelConsumption(kind) * STEP / 1e3
                used[kind] = electricity, fuel
    finally:
        libsumo.close()
    return {name: used[kind] for kind, name in names.items()}


def trace(name: str) -> Tensor:
    """Return the speeds of a cycle or moment in steps of 0.1 s [m/s]."""
    return MOMENTS[name] if name in MOMENTS else resample(*read_speed_record(name), STEP)


def compared(name: str) -> pd.DataFrame:
    """Return a row per model: what it takes on a cycle, in all and per kilometre."""
    speed = trace(name)
    kilometres = float((speed[1:] + speed[:-1]).sum()) / 2.0 * STEP / 1e3
    used = {}
    for own, model in own_models().items():
        moments = {own: speed[:-1]}
        if own.endswith("unlimited"):
            moments[f"{own}, mid-step"] = 0.5 * (speed[1:] + speed[:-1])
        for label, moment in moments.items():
            energy = float(model.power(moment, speed.diff() / STEP).sum()) * STEP
            if isinstance(model, CirclesFuel):
                used[label] = (0.0, energy / model.heat)
            else:
                used[label] = (energy / 3600.0, 0.0)
    with tempfile.TemporaryDirectory() as folder:
        used |= driven_in_sumo(speed, Path(folder))
    rows = [(name, model, *totals, kilometres) for model, totals in used.items()]
    names = ("cycle", "model", "electricity_wh", "fuel_g", "distance_km")
    table = pd.DataFrame(rows, columns=names).replace(0.0, np.nan)
    table["electricity_wh_per_km"] = table["electricity_wh"] / table["distance_km"]
    table["fuel_g_per_km"] = table["fuel_g"] / table["distance_km"]
    return table


def main(words: Sequence[str] | None = None) -> int:
    """Compare on all cycles."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    reference = Path("outputs/reference/sumo_energy.parquet")
    parser.add_argument("--reference", type=Path, default=reference, help="where rows are kept")
    options = parser.parse_args(words)
    table = pd.concat(map(compared, (*CYCLES, *MOMENTS)), ignore_index=True)
    write_parquet(table, options.reference)
    for name in ("electricity_wh", "fuel_g"):
        known = table.dropna(subset=name)
        for column, cycles in ((f"{name}_per_km", CYCLES), (name, tuple(MOMENTS))):
            wide = known.pivot(index="model", columns="cycle", values=column)
            print(f"{column}\n{wide[list(cycles)].round(1).to_string()}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main_guard(main)())
