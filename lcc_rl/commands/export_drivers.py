"""Write calibrated drivers as vehicle types of SUMO, one ``vType`` each.

    lcc-rl drivers drivers.parquet vtypes.xml

SUMO's IDM has the same law (``tests/properties/test_sumo.py`` compares both, with SUMO's ballistic
steps); it has no optimal velocity model, full velocity difference model or Gipps' model.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import pandas as pd

from lcc_rl.drivers.parameters import COLUMNS, IDM
from lcc_rl.drivers.tables import load_drivers, models_of
from lcc_rl.errors import DataError
from lcc_rl.io.atomic import atomic_path

# Attribute of a vType by parameter of the IDM; both are in m, s and m/s.
ATTRIBUTES = {
    "desired_speed": "maxSpeed",
    "time_gap": "tau",
    "acceleration": "accel",
    "deceleration": "decel",
    "min_gap": "minGap",
}
# Without a spread of its own: a driver's desired speed is its own parameter.
FIXED = {"carFollowModel": "IDM", "sigma": "0", "speedFactor": "1", "speedDev": "0"}


def vehicle_types(drivers: pd.DataFrame, name: str) -> ElementTree.Element:
    """Return SUMO's vehicle types of a driver table.

    ``maxSpeed`` and ``desiredMaxSpeed`` are v0; in SUMO a lower speed limit of the road binds.

    Args:
        drivers: calibrated drivers of one mode.
        name: of the table, for messages.

    Returns:
        The element ``additional`` with one ``vType`` per driver, ids ``driver0``, ``driver1`` ….

    Raises:
        DataError: naming table and row, if a driver has a model that SUMO lacks.
    """
    models = models_of(drivers, name)
    foreign = (models != IDM).to_numpy()
    if foreign.any():
        place = int(foreign.argmax())
        raise DataError(
            f"{name}: row {place}: SUMO has no car-following model {models.iloc[place]!r}; "
            "expected drivers of the model 'idm'"
        )
    root = ElementTree.Element("additional")
    for number, row in enumerate(drivers.to_dict("records")):
        own = {key: f"{row[COLUMNS[part]]:.6g}" for part, key in ATTRIBUTES.items()}
        own["desiredMaxSpeed"] = own["maxSpeed"]
        ElementTree.SubElement(root, "vType", {"id": f"driver{number}", **FIXED, **own})
    return root


def export(source: str | Path, target: str | Path, mode: str | None = None) -> int:
    """Write the drivers of a table; return their number.

    Args:
        source: a ``drivers.parquet`` of the calibration.
        target: the XML file.
        mode: see :func:`lcc_rl.drivers.tables.load_drivers`.

    Raises:
        LccError: if the table is not sound, has drivers of other models, or the file cannot be
            written.
    """
    root = vehicle_types(load_drivers(source, mode), str(source))
    ElementTree.indent(root)
    with atomic_path(target) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)
    return len(root)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("drivers", help="table of calibrated drivers, parquet")
    parser.add_argument("target", help="XML file to write, for SUMO's --additional-files")
    parser.add_argument("--mode", help="local or global; by default the one that the table has")
    options = parser.parse_args(arguments)
    count = export(options.drivers, options.target, options.mode)
    print(f"{count} vehicle types in {options.target}")
    return 0
