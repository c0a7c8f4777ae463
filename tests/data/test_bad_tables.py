"""Tables that no reader accepts: each gives one line naming the file, the place and the reason."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import pandas as pd
from helpers import check_refused
from ngsim_text import OFFICIAL, cells, csv_text, native_text, pair, portal_text
from table_text import READERS, long_table, openacc_text, pairs

from lcc_rl.data.sources import EpisodesSource
from lcc_rl.errors import Concern, DataError

GOOD = csv_text(pair())
TABLE = long_table()
RECORD = "time_s,speed_mps\n"
APART = pairs().assign(  # gap and speeds at their own times
    gap_m=pairs()["gap_m"].where(pairs().index % 2 == 0),
    follower_speed_mps=pairs()["follower_speed_mps"].where(pairs().index % 2 == 1),
)
DRIVES = "drive,time_s,speed_mps\na,0,1\n"


def ngsim(**change: object) -> str:
    """A valid file but for one row, the third."""
    return csv_text([cells(7, 1), cells(7, 2), cells(7, 3, **change), cells(7, 4)])


def change(frame: pd.DataFrame, row: int, **values: object) -> str:
    changed = frame.astype(dict.fromkeys(values, object))
    changed.loc[row, list(values)] = list(values.values())
    return changed.to_csv(index=False)


def table(row: int = 500, **values: object) -> str:
    return change(TABLE, row, **values)


def episodes(row: int, **values: object) -> str:
    return change(pairs(2, 5), row, **values)


def csv(frame: pd.DataFrame) -> str:
    return frame.to_csv(index=False)


def later(factor: float, drive: str = "", speed: float = 1.0) -> str:
    """A table, or the drive of its first car, with other times and speeds."""
    frame = TABLE.assign(t=factor * TABLE["t"], v=speed * TABLE["v"])
    names = {"t": "time_s", "v": "speed_mps"} if drive else {}
    return csv(frame.rename(columns=names)[: 400 if drive else None])


LATE = TABLE.assign(t=TABLE["t"].where(TABLE.index < 1190, 1e11 + TABLE["t"]))
TWICE = csv(pd.concat([pairs(), pairs().assign(gap_m=12.0)]))
COMMAS = TABLE.to_csv(index=False, sep=";", decimal=",")
MINUTES = (95930 + TABLE["t"]).where(TABLE["t"] < 29.95, 99970 + TABLE["t"])  # hhmmss
WIDE = "drive; type; way; mean; y; x; speed_mps; a; b; time_s\n"  # as pNEUMA's files
WIDE += "".join(
    f"{k}; Car; 9.1; 9.0" + "; 37.9; 23.7; 9.0; 0.1; 0.0; 0.0" * 9 + "; \n" for k in "12"
)
# Reader, content of the file, what is said of it.
BAD: list[tuple[str, str | bytes, str]] = [
    # Files that are no tables.
    ("ngsim", "", "not a readable table: empty"),
    ("ngsim", OFFICIAL + "\n", "has no rows"),
    ("ngsim", "<!DOCTYPE html>\n<html>Not found</html>\n", "is XML or HTML; save"),
    ("ngsim", bytes(range(256)) * 40, "is not UTF-8 text"),
    (
        "ngsim",
        GOOD.encode("utf-16-le").join([b"\xff\xfe", b"\0\xdc\n\0"]),
        "but in UTF-16; save it in UTF-8",
    ),
    ("ngsim", GOOD.encode() + b"7,\xe9,1" + b",1" * 15 + b"\n", "row 41, column 'Frame_ID' holds"),
    ("ngsim", gzip.compress(GOOD.encode())[:-20], "damaged or cut off"),
    ("table", b"id,t,v,ahead,gap,x\n1,0,\xff,0,1,1\n", "column 'v' holds 'ÿ'"),
    (
        "table",
        b"PK\x03\x04" + bytes(40),
        r"is not UTF-8 text but a spreadsheet \(xlsx, ods\) .*as CSV",
    ),
    ("table", b"\xd0\xcf\x11\xe0" + bytes(40), r"but an Excel workbook \(xls\); save .*CSV"),
    ("table", b"MATLAB 5.0 MAT-file" + bytes(9), r"but a MATLAB file \(mat\); .*writetable"),
    ("record", b"\x89HDF\r\n\x1a\n" + bytes(40), "but an HDF5 or MATLAB file"),
    ("table", b"PAR1" + bytes(40), r"but a parquet file; name it \.parquet"),
    ("record", "0,1\n1,2\n", "it has 0, 1: is the header missing"),
    ("table", b"id,t\r,v\n1,0,5\n", "empty, or names no columns"),
    # Columns and rows that are missing or twice.
    (
        "ngsim",
        GOOD + "7,21,20,1113",
        "data row 41, the last, has 4 columns; expected 18; is the file cut",
    ),
    ("ngsim", native_text(pair()) + " 7 21 5\n", "data row 41, the last, has 3 columns"),
    ("ngsim", native_text([row[:17] for row in pair()]), "has 17 columns and no header"),
    ("ngsim", GOOD.replace("v_Vel", "v_Velo"), r"lacks the column v_Vel \(is it 'v_Velo'\?\); it"),
    ("ngsim", GOOD.replace("v_Width", "V LENGTH"), "has column 'v_Length' twice"),
    ("ngsim", ngsim(Local_X='"18.0'), "quote|columns; expected 18"),
    ("i-80", portal_text(pair(), "us-101"), r"'i-80'; .*found are us-101 \(40 rows\)"),
    (
        "table",
        csv(TABLE.rename(columns={"v": "V", "ahead": "front", "id": "ID"})),
        r"lacks the column id \(is it 'ID'\?\), v \(is it 'V'\?\), ahead; it has.*columns=",
    ),
    ("table", "t,v1,v2,s1,s2\n0,1,1,2,2\n", "lacks .*; does a row hold several vehicles"),
    ("table", csv(pd.concat([TABLE, TABLE["v"]], axis=1)), "has column 'v' twice"),
    ("table", "id,t,v,ahead,gap,x\n1,0,1,0,2\n", "data row 1, the last, has 5 columns"),
    ("table", "id,t,v,ahead,gap,x\n1,0,1,0,2\n1,1,1,0,2,3\n", "row 1 has 5 columns; expected 6$"),
    ("table", csv(TABLE.iloc[:0]), "has a header but no rows"),
    ("episodes", csv(pairs().drop(columns="gap_m")), "lacks the column gap_m.*data.columns="),
    (
        "episodes",
        csv(pairs().drop(columns="gap_m").assign(leader_position_m=0.0)),
        r"lacks the column gap_m; .*; data=table has gaps of positions: data.columns=\{vehicle: …",
    ),
    (
        "episodes",
        csv(pairs().rename(columns={"leader_speed_mps": "relSpeed"})),
        r"lacks the column leader_speed_mps.*\(set data.columns.relative_speed=relSpeed\)",
    ),
    ("openacc", openacc_text().replace("IVS", "gap"), "lacks IVS1, IVS2"),
    ("openacc", csv(TABLE), "expected a native OpenACC file"),
    ("record", RECORD, "holds 0 samples"),
    # Cells that are blank, words, not finite or out of range.
    ("ngsim", ngsim(v_Vel="abc"), "data row 3, column 'v_Vel' holds 'abc'; expected a number"),
    ("ngsim", ngsim(Local_Y="NaN"), "row 3, column 'Local_Y' holds nothing; expected a number"),
    ("ngsim", ngsim(Vehicle_ID=""), "row 3, column 'Vehicle_ID' holds nothing; expected a whole"),
    ("ngsim", ngsim(v_Acc="inf"), "data row 3, column 'v_Acc' holds 'inf'"),
    ("ngsim", ngsim(Vehicle_ID="7.5"), "column 'Vehicle_ID' holds '7.5'; expected a whole number"),
    ("ngsim", ngsim(Lane_ID="70000"), "data row 3, column 'Lane_ID' holds '70000'"),
    ("table", table(v="fast"), "data row 501, column 'v' holds 'fast'; expected a number"),
    ("table", table(v=1e20), r"data row 501, column 'v' holds '1e\+20'"),
    (
        "table",
        table(t="03/29/2026 9:59:30 AM"),
        "AM'; expected a number, or hh:mm:ss, or a time of",
    ),
    ("table", COMMAS.replace(";11,", ";1l,", 1), "column 'v' holds '1l,"),
    ("table", csv(TABLE.assign(v="")), "data row 1, column 'v' is blank"),
    ("table", table(id=""), "data row 501, column 'id' is blank"),
    ("table", table(id="x" * 1001), "data row 501, column 'id' holds a text of 1,001 characters"),
    ("record", RECORD + "0,1\n1,fast\n", "data row 2, column 'speed_mps' holds 'fast'"),
    # Files of other programs: lines before and below the header, signals at their own times.
    ("table", "ACC test 3\n" + csv(TABLE), "is it a title or a comment.*must name the columns"),
    ("table", "ACC test 3,,,,\n" + csv(TABLE), "is it a title or a comment"),
    ("table", "# 2024-05-01\n" + csv(TABLE), "is it a title or a comment"),
    (
        "table",
        csv(TABLE).replace("\n", "\n-,s,m/s,m,-,-,m,m\n", 1),
        "row 1, .*does this row hold uni",
    ),
    ("record", "version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "run git lfs pull"),
    ("record", "File created on 03/05/2023\n\n[header]\n", r"is a VBOX file \(vbo\): save its"),
    ("record", "MDF     4.10    asammdf8", "is an MDF measurement: save its channels .* asammdf"),
    ("table", "<?xml version='1.0'?>\n<fcd-export/>\n", "is XML or HTML; save the table as CSV"),
    ("table", "<fcd-export>\n</fcd-export>\n", r"is XML or HTML; .*\(SUMO: --fcd-output fcd.csv\)"),
    (
        "episodes",
        csv(APART),
        r"row 1, column 'follower_speed_mps' is blank or NaN; no row has .*set_index\('time_s'\).i",
    ),
    (
        "episodes",
        csv(pairs()).replace("leader_position_m", "time_s", 1),
        "has column 'time_s' twice; .* common times",
    ),
    ("record", RECORD + "".join(f"{x},1\n" for x in range(90) if x % 60 < 30), "a hole of 31 s"),
    ("record", RECORD + "0,1\n1,\n2,1\n", "data row 2, column 'speed_mps' is blank"),
    # Rows that contradict each other, and times.
    ("table", csv(LATE), r"data row 1191, vehicle 3 is 1e\+11 s after the first"),
    ("table", csv(TABLE.assign(id=range(len(TABLE)))), "no vehicle has two samples"),
    ("episodes", episodes(3, leader_id=8), "row 4, column 'leader_id' changes within an episode"),
    (
        "episodes",
        TWICE,
        "row 601, column 'time_s' repeats a time of its episode with other values, as do 50 %",
    ),
    ("table", csv(TABLE.assign(t=0.0)), "data row 2, vehicle 1, column 't' repeats a time of"),
    ("leaders", RECORD + "0,1\n1,2\n2,1\n", r"covers 0–2 s, not the stretch 0–9 s"),
    ("table", csv(TABLE.assign(ahead=TABLE["id"])), "none .* other than itself; .* column 'ahead'"),
    # Values that are implausible, and units.
    ("ngsim", csv_text(pair(v_Length=4.5, Preceding=0)[:20]), "is 4.5 feet; .*data.units=metres"),
    ("source", csv_text(pair(range(200), v_Vel=400)), "holds 121.92 m/s .*max_speed=70"),
    (
        "table",
        later(1e3),
        r"100 s apart; .*from 0 to 39900, in ms \(data\.units\.time=ms\), or are",
    ),
    ("table", later(1e6), r"apart; .* in us \(data\.units\.time=us\), or are rows missing\?"),
    (
        "drives",
        later(120, "d"),
        r"are 12 s apart; .* from 0 to 4788, in ms \(leader\.units\.time=ms",
    ),
    ("drives", DRIVES + "a,1.7e12,1\na,1.8e12,1\n", r"7e12'; .* ms, us or ns \(leader.units.time"),
    ("table", csv(TABLE.assign(t=MINUTES)), "row 301, .*: 95959.9 s, then 100000 s, .* hh:mm:ss"),
    ("table", csv(TABLE.assign(x=-TABLE["x"], v=-TABLE["v"])), "must grow in the direction of tr"),
    ("drives", later(0.6, "d", 4.6), r"\(leader\.units\.speed=m/s\), or do they need smoothing"),
    ("lengths", csv(TABLE.assign(length=2.3)), r"is 2\.3 m; is it in ft or half\? Set data\.units"),
    ("drives", later(1, "d", 6), r"holds 7.* correct .* leader\.units\.speed=m/s, or raise"),
    ("drives", WIDE, r"row 1 has \d+ columns; expected 10: is it a whole trajectory, as in pNEUMA"),
    ("table", csv(TABLE.assign(v=3.6 * TABLE["v"])), "by their positions the vehicles drive"),
    ("table", csv(TABLE.assign(x=-TABLE["x"])), "must grow in the direction of travel"),
    ("drives", DRIVES + "a,0.1,1\na,0.2,9\n", "recording a, data row 3, .* changes by 80 m/s²"),
    ("record", RECORD + "0,540\n1,540\n", r"data row 1, .* holds 540 m/s .*plausible\.max_speed"),
]


def test_a_bad_table_gives_one_line(tmp_path: Path) -> None:
    def read(reader: str, content: str | bytes) -> None:
        path = tmp_path / "bad.csv"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        READERS[reader](str(path))

    check_refused(read, ((*given, rf"bad\.csv.*({words})") for *given, words in BAD), DataError)


ODD = [  # and what is reported
    ("table", table(t=9.9), "1 rows: .* 1 of them with .*data row 501, vehicle 2, column 't'"),
    ("openacc", openacc_text().replace("430.5,", "430.4,", 1), "3 rows: .* 3 of .*data row 6,"),
    ("drives", DRIVES + "a,0.1,1\na,0.1,1\na,0.2,1\n", "1 rows: .* 0 of them .*data row 3,"),
    ("drives", DRIVES + "a,0.2,1\na,0.1,1\n", "are not in order of time: sorted"),
    ("drives", DRIVES + "b,0,1\nb,0.1,1\n", "1 rows: alone between holes"),
    (
        "drives",
        DRIVES + "a,0.1,1\na,0.2,\na,,\n",
        "left out 2 rows with a blank cell, .*data row 3,",
    ),
]


def test_a_relative_speed_is_named_by_its_column(tmp_path: Path) -> None:
    path = tmp_path / "relative.csv"

    def read(name: str) -> None:
        path.write_text(csv(pairs().rename(columns={"leader_speed_mps": name})))
        EpisodesSource(path=str(path), columns={"leader_speed": name}).load()

    names = ("rel_speed", "RelativeSpeed", "dV (m/s)", "Range rate", "delta_v")
    words = "column '{}' is relative: name it data.columns.relative_speed"
    check_refused(read, [(x, words.format(re.escape(x))) for x in names], DataError)
    read("reliable_speed")


def test_of_rows_of_a_moment_the_first_is_kept_and_records_are_sorted(tmp_path: Path) -> None:
    for reader, content, words in ODD:
        (tmp_path / "odd.csv").write_text(content)
        found = READERS[reader](str(tmp_path / "odd.csv"))
        report = found[1] if isinstance(found, tuple) else found.report
        assert any(re.search(words, line) for line in report), report


CUT = [  # and its last row
    ("table", csv(TABLE), "data row 1200"),
    ("table", csv(TABLE).replace("\n", "\r\n"), "data row 1200"),
    ("episodes", csv(pairs()), "data row 600"),
    ("openacc", openacc_text(), "data row 400"),
    ("source", csv_text(pair(range(200))), "data row 400"),
    ("source", native_text(pair(range(200))).rstrip() + "0\n", "data row 400"),
]


def test_a_file_that_ends_within_its_last_cell_is_read_with_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "cut.csv"
    for reader, content, place in CUT:
        path.write_bytes(content.encode())
        whole = READERS[reader](str(path)).report
        path.write_bytes(content.rstrip().encode()[:-1])
        lines = [line for line in READERS[reader](str(path)).report if line not in whole]
        assert [type(line) for line in lines] == [Concern], reader
        words = rf"{path}: {place}, the last, ends in '.*' without a line end; .*"
        assert re.fullmatch(words, lines[0])


def test_a_damaged_parquet_file(tmp_path: Path) -> None:
    path = tmp_path / "bad.parquet"
    for words, content in (
        ("no such file", None),
        ("not a .* table", b""),
        ("not a", b"PAR1 PAR1"),
    ):
        if content is not None:
            path.write_bytes(content)
        cases = [(name, rf"bad\.parquet: {words}") for name in ("table", "episodes", "record")]
        check_refused(lambda reader: READERS[reader](str(path)), cases, DataError)
