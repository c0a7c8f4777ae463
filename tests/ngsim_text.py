"""Small NGSIM files in every published layout, for the tests of the reader."""

from __future__ import annotations

from collections.abc import Sequence

START_MS = 1113433135300  # of frame 0: 2005-04-13, 22:58:55 UTC
OFFICIAL = (
    "Vehicle_ID,Frame_ID,Total_Frames,Global_Time,Local_X,Local_Y,Global_X,Global_Y,v_Length,"
    "v_Width,v_Class,v_Vel,v_Acc,Lane_ID,Preceding,Following,Space_Headway,Time_Headway"
)
PORTAL = (
    "Vehicle_ID,Frame_ID,Total_Frames,Global_Time,Local_X,Local_Y,Global_X,Global_Y,v_length,"
    "v_Width,v_Class,v_Vel,v_Acc,Lane_ID,O_Zone,D_Zone,Int_ID,Section_ID,Direction,Movement,"
    "Preceding,Following,Space_Headway,Time_Headway,Location"
)


def cells(vehicle: int, frame: int, **changes: object) -> list[str]:
    """One row in the official order: a car at 10·frame ft, of 15 ft, at 100 ft/s, on lane 2."""
    row: dict[str, object] = {
        "Vehicle_ID": vehicle,
        "Frame_ID": frame,
        "Total_Frames": 20,
        "Global_Time": START_MS + 100 * frame,
        "Local_X": 18.0,
        "Local_Y": 10.0 * frame,
        "Global_X": 0.0,
        "Global_Y": 0.0,
        "v_Length": 15.0,
        "v_Width": 6.4,
        "v_Class": 2,
        "v_Vel": 100.0,
        "v_Acc": -1.5,
        "Lane_ID": 2,
        "Preceding": 0,
        "Following": 0,
        "Space_Headway": 0,
        "Time_Headway": 0,
    }
    unknown = changes.keys() - row.keys()
    assert not unknown, unknown
    return [str(value) for value in (row | changes).values()]


def pair(frames: Sequence[int] = range(20), **changes: object) -> list[list[str]]:
    """A follower 7 and its leader 9, 60 ft ahead."""
    follower = [cells(7, k, **{"Preceding": 9, "Space_Headway": 60, **changes}) for k in frames]
    leader = [cells(9, k, Local_Y=10.0 * k + 60, Following=7) for k in frames]
    return follower + leader


def csv_text(rows: list[list[str]], header: str = OFFICIAL) -> str:
    """CSV with a header."""
    return "\n".join([header, *(",".join(row) for row in rows)]) + "\n"


def native_text(rows: list[list[str]]) -> str:
    """Columns aligned by spaces, as the native files are, without a header."""
    return "".join("".join(f"{cell:>16}" for cell in row) + " \n" for row in rows)


def portal_text(rows: list[list[str]], location: str = "i-80") -> str:
    """The portal's 25 columns: a byte-order mark, thousands separators, descending frames."""
    lines = []
    for row in sorted(rows, key=lambda row: -int(row[1])):
        spelled = [
            grouped(cell) if place in (0, 1, 2, 14, 15) else cell for place, cell in enumerate(row)
        ]
        lines.append([*spelled[:14], "0", "0", "", "1", "2", "1", *spelled[14:], location])
    return "\ufeff" + csv_text(lines, PORTAL)


def grouped(cell: str) -> str:
    """A whole number with thousands separators, quoted where it has any."""
    text = f"{int(cell):,}" if cell.lstrip("-").isdigit() else cell
    return f'"{text}"' if "," in text else text
