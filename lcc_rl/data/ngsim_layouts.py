"""Published column layouts of NGSIM files and their detection from the first line."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from difflib import get_close_matches

from lcc_rl.errors import DataError

HEADER = (
    "Vehicle_ID,Frame_ID,Total_Frames,Global_Time,Local_X,Local_Y,Global_X,Global_Y,v_Length,"
    "v_Width,v_Class,v_Vel,v_Acc,Lane_ID,Preceding,Following,Space_Headway,Time_Headway"
)
REQUIRED = "Vehicle_ID,Frame_ID,Local_Y,v_Length,v_Class,v_Vel,v_Acc,Lane_ID,Preceding"
OPTIONAL = "Global_Time,Space_Headway,Location"
OFFICIAL = HEADER.split(",")
NEEDED = REQUIRED.split(",")
KNOWN = NEEDED + OPTIONAL.split(",")
# Other spellings in the documents of the four sites, in lower case without separators.
ALIASES = {
    "spacehdwy": "Space_Headway",
    "spacing": "Space_Headway",
    "preceeding": "Preceding",
    "precedingvehicle": "Preceding",
    "vehiclelength": "v_Length",
    "vehicleclass": "v_Class",
    "vehiclevelocity": "v_Vel",
    "vehicleacceleration": "v_Acc",
    "laneidentification": "Lane_ID",
}


@dataclass(frozen=True)
class Layout:
    """Layout of one file.

    Args:
        width: number of columns of a row.
        places: place of every known column, by its official name.
        header: whether a header line precedes the rows.
        spaced: whether columns are separated by white space instead of commas.
    """

    width: int
    places: dict[str, int]
    header: bool
    spaced: bool


def detect_layout(name: str, lines: bytes) -> tuple[Layout, bytes]:
    """Detect the layout from the first line; returns it and the lines that hold rows."""
    first, _, rest = lines.partition(b"\n")
    try:
        text = first.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DataError(
            f"{name}: the first line is not UTF-8 text; expected an NGSIM table"
        ) from error
    if "\0" in text:
        raise DataError(f"{name}: is a binary file; expected an NGSIM text table, plain or .gz")
    spaced = "," not in text
    try:
        cells = text.split() if spaced else [cell.strip() for cell in next(csv.reader([text]))]
    except csv.Error as error:
        raise DataError(f"{name}: the first line is not a CSV header: {error}") from error
    if not cells or not _is_number(cells[0]):
        return Layout(len(cells), _places(name, cells), header=True, spaced=spaced), rest
    if len(cells) != len(OFFICIAL):
        raise DataError(
            f"{name}: the first line has {len(cells)} columns and no header; expected the "
            f"{len(OFFICIAL)} columns of the native layout"
        )
    places = {column: place for place, column in enumerate(OFFICIAL) if column in KNOWN}
    return Layout(len(OFFICIAL), places, header=False, spaced=spaced), lines


def _places(name: str, header: list[str]) -> dict[str, int]:
    """Where the known columns are in a header, whatever its letter case and separators."""
    known = {_folded(column): column for column in KNOWN} | ALIASES
    places: dict[str, int] = {}
    for place, cell in enumerate(header):
        column = known.get(_folded(cell))
        if column is None:
            continue
        if column in places:
            raise DataError(f"{name}: the header has column {column!r} twice; expected it once")
        places[column] = place
    for column in NEEDED:
        if column not in places:
            folded = {_folded(cell): cell for cell in header}
            near = get_close_matches(_folded(column), folded, n=1)
            hint = f"; the nearest is {folded[near[0]]!r}" if near else ""
            shown = ", ".join(header[:30])[:400]
            raise DataError(f"{name}: the header has no column {column!r}{hint}. It has: {shown}")
    return places


def _folded(cell: str) -> str:
    return re.sub(r"[\s_]+", "", cell).lower()


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", ""))
    except ValueError:
        return False
    return True
