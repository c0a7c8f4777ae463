"""Print the table of an evaluation in several formats.

lcc-rl table outputs/evaluate/<run>
lcc-rl table outputs/evaluate/<run> --all               # every measure
lcc-rl table outputs/evaluate/<run> --against idm       # another baseline
lcc-rl table outputs/evaluate/<run> --unit kWh/100km
lcc-rl table outputs/evaluate/<run> --format latex      # for booktabs
lcc-rl table outputs/evaluate/<run> --columns driver,saved_pct
lcc-rl table outputs/evaluate/<run> --format csv --decimal comma
lcc-rl table outputs/train/<sweep> --figure sweep.pdf   # a row per setting
lcc-rl table outputs/train/<sweep> --rename alcc full --against full
lcc-rl table outputs/alcc/tables/<table>.parquet --format latex
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pydantic import Field

from lcc_rl.config.words import SHOWN_AS
from lcc_rl.runs.arguments import Arguments, typed
from lcc_rl.runs.interrupts import ending_quietly


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table of a run or of a parquet file."""
    parser = Arguments(prog="lcc-rl table", description=__doc__)
    what = "folder of an evaluation, a training, a job or a sweep; or a parquet file"
    parser.add_argument("run", type=Path, help=what)
    form = "text by default, as the run prints it; markdown for --columns and parquet files"
    parser.add_argument("--format", choices=SHOWN_AS, default="text", help=form)
    parser.add_argument("--all", action="store_true", help="all measures, as table=all")
    parser.add_argument("--columns", help="names of columns of --format csv, separated by commas")
    parser.add_argument("--against", help="baseline of savings, a name of the table")
    unit = "of energy per distance: kJ/km, Wh/km, kWh/100km, and for one fuel g/km, L/100km, mpg"
    parser.add_argument("--unit", help=unit)
    new = "another name of a row, in all formats; may be repeated"
    parser.add_argument("--rename", nargs=2, action="append", metavar=("ROW", "NAME"), help=new)
    ending = typed(Annotated[str, Field(pattern=r"\.(png|pdf|svg)$")])
    parser.add_argument("--figure", type=ending, help="also draw the table: a .png, .pdf or .svg")
    parser.add_trust()
    marks = "decimal mark of --format csv; with comma, columns are separated by ;"
    parser.add_argument("--decimal", choices=("point", "comma"), default="point", help=marks)
    options = parser.parse_args(arguments)
    if options.decimal == "comma" and options.format != "csv":
        parser.error("--decimal comma needs --format csv")
    with ending_quietly():  # loads torch
        from lcc_rl.commands.table import print_again
    print_again(options)
