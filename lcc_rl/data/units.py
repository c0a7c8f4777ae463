"""Units of published files: their conversion to SI, and the check that a file is in them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import pandas as pd

from lcc_rl.errors import DataError, unknown_name

FOOT = 0.3048  # m
FRAME = 0.1  # s; every published NGSIM file has 10 frames a second
FACTORS = {"feet": FOOT, "metres": 1.0}
CAR = (2.0, 12.0)  # m; between them lies the median length of vehicles on any road
JAM = 3.0  # m; front to front, no two cars are closer in a queue


def factor(units: str) -> float:
    """Return the metres of a unit of length.

    Raises:
        ConfigError: if the unit is neither feet nor metres.
    """
    if units not in FACTORS:
        raise unknown_name("setting of data.units", str(units), FACTORS)
    return FACTORS[units]


def check_units(samples: pd.DataFrame, units: str, files: Sequence[str]) -> None:
    """Check that the vehicles of every recording are as long as vehicles are.

    Where a file gives no lengths, the shortest headways (1 % quantile) are looked at instead.

    Args:
        samples: see :class:`lcc_rl.data.trajectories.Trajectories`.
        units: what the files were taken to be in.
        files: for the message.

    Raises:
        DataError: naming the recording, what was found and, where another unit fits, what to set.
    """
    for name, part in samples.groupby("recording", observed=True):
        lengths = part.groupby("vehicle")["length_m"].first()
        lengths = lengths[lengths > 0]
        headways = part.loc[part["space_headway_m"] > 0, "space_headway_m"]
        if len(lengths):
            what, found, (low, high) = "the median length of vehicles", float(lengths.median()), CAR
        elif len(headways):
            what, found = "the least headway (1 % quantile)", float(headways.quantile(0.01))
            low, high = JAM, float("inf")
        else:
            continue
        if not low <= found <= high:
            published = found / FACTORS[units]
            fits = [unit for unit, metres in FACTORS.items() if low <= published * metres <= high]
            remedy = f"is the file in {fits[0]}? say data.units={fits[0]}" if fits else "mend it"
            raise DataError(
                f"{', '.join(files)}: recording {name}: {what} is {published:.3g} {units}; "
                f"expected {low:g} to {high:g} m: {remedy}"
            )


SPEEDS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "ft/s": FOOT, "kn": 1852 / 3600}
# Units that the columns of a table may be in, by what they measure, and their size in SI.
QUANTITIES: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0},
    "speed": {**SPEEDS, "kph": SPEEDS["km/h"]},
    "length": {"m": 1.0, "cm": 0.01, "km": 1000.0, "ft": FOOT},
}
# What the columns of tables measure, by their key.
MEASURES = {
    "time": "time",
    "speed": "speed",
    "position": "length",
    "gap": "length",
    "length": "length",
}


def factors(units: Mapping[str, str], keys: Iterable[str], option: str) -> dict[str, float]:
    """Return the factor to SI of every column of numbers.

    Args:
        units: the unit by the column's key; SI for those that are not named.
        keys: of the columns that there may be.
        option: where the configuration has the units, for messages.

    Raises:
        ConfigError: if a key or a unit is unknown.

    Examples:
        >>> factors({"speed": "km/h"}, ["time", "speed"], "leader.units")
        {'time': 1.0, 'speed': 0.2777777777777778}
    """
    known = [key for key in keys if key in MEASURES]
    for key, unit in units.items():
        if key not in known:
            raise unknown_name(f"key of {option}", str(key), known)
        if unit not in QUANTITIES[MEASURES[key]]:
            raise unknown_name(f"unit in {option}.{key}:", str(unit), QUANTITIES[MEASURES[key]])
    return {key: QUANTITIES[MEASURES[key]][units[key]] if key in units else 1.0 for key in known}
