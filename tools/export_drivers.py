"""Write calibrated IDM drivers as vehicle types of SUMO, one ``vType`` each.

    python tools/export_drivers.py drivers.parquet vtypes.xml

SUMO's IDM has the same law; SUMO has none of the other models.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import pandas as pd

from lcc_rl.cli.guard import main_guard
from lcc_rl.drivers.parameters import COLUMNS, IDM
from lcc_rl.drivers.tables import load_drivers, models_of
from lcc_rl.errors import DataError
from lcc_rl.io.atomic import atomic_path, new_file

# Attribute of a vType by parameter of the IDM; both are in m, s and m/s.
ATTRIBUTES = {
    "desired_speed": "maxSpeed",
    "time_gap": "tau",
    "acceleration": "accel",
    "deceleration": "decel",
    "min_gap": "minGap",
}
# Every driver has a desired speed of its own, to which SUMO adds no spread.
FIXED = {"carFollowModel": "IDM", "sigma": "0", "speedFactor": "1", "speedDev": "0"}


def vehicle_types(drivers: pd.DataFrame, name: str) -> ElementTree.Element:
    """Return SUMO's vehicle types of a driver table, ids ``driver0``, ``driver1`` ….

    ``maxSpeed`` and ``desiredMaxSpeed`` are v0; a lower speed limit of the road still binds.

    Args:
        drivers: calibrated drivers of one mode.
        name: name of the table, for messages.

    Raises:
        DataError: if a driver has another model than the IDM.
    """
    foreign = (models_of(drivers, name) != IDM).to_numpy()
    if foreign.any():
        raise DataError(f"{name}: row {foreign.argmax()}: SUMO has the driver model 'idm' only")
    root = ElementTree.Element("additional")
    for number, row in enumerate(drivers.to_dict("records")):
        own = {key: f"{row[COLUMNS[part]]:.6g}" for part, key in ATTRIBUTES.items()}
        own["desiredMaxSpeed"] = own["maxSpeed"]
        ElementTree.SubElement(root, "vType", {"id": f"driver{number}", **FIXED, **own})
    return root


def main(words: Sequence[str] | None = None) -> int:
    """Write the vehicle types of the table named on the command line."""
    parser = argparse.ArgumentParser(description="Calibrated drivers as vehicle types of SUMO.")
    parser.add_argument("drivers", help="table of calibrated drivers, parquet")
    parser.add_argument("target", type=Path, help="file for SUMO's --additional-files")
    parser.add_argument("--mode", help="local or global; by default the one that the table has")
    options = parser.parse_args(words)
    root = vehicle_types(load_drivers(options.drivers, options.mode), options.drivers)
    ElementTree.indent(root)
    with atomic_path(new_file(options.target, "target")) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)
    print(f"{len(root)} vehicle types in {options.target}")
    return 0


if __name__ == "__main__":
    main_guard(main)()
