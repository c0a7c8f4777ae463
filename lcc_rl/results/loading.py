"""Tables of many runs as one."""

from __future__ import annotations

import json
import logging
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from textwrap import shorten
from typing import Any, Literal, overload

import pandas as pd
import pyarrow as pa
from pandas.api.types import is_numeric_dtype
from pyarrow.dataset import Dataset

from lcc_rl.errors import ConfigError, ResultsError, nearest, require_known
from lcc_rl.io.atomic import SUBFOLDERS
from lcc_rl.io.files import (
    VERSION,
    Rows,
    as_dataset,
    parquet_metadata,
    read_table,
    schema_of,
    texts_of,
    unified,
)
from lcc_rl.results.runs import CONFIG, FINAL, PARTS, flat_settings
from lcc_rl.runs.plans import choices_of, unfinished

log = logging.getLogger("lcc_rl")

# The tables of a run and their required columns.
TABLES = {
    "episodes": ("strategy",),
    "training": ("iteration",),
    "timing": ("iteration",),
    "steps": ("strategy", "time_s"),
    "drivers": ("desired_speed_mps", "time_gap_s"),
}
MOST = 12  # most runs in a sentence
# In the name of a run: all but the last two words of a key, and the hash.
KEY, HASH = re.compile(r"(?:[\w-]+\.)+(?=\w+\.\w+=)"), re.compile(r"_[0-9a-f]{8}$")
ALWAYS = ("variant", "seed")  # settings that are columns even if all runs agree
SHARD, SHARDS = "evaluation.shard", "evaluation.shards"
# Nullable integers of pandas.
NULLABLE = {pa.int64(): pd.Int64Dtype(), pa.int32(): pd.Int32Dtype()}
Runs = dict[Path, dict[str, Any]]  # the settings of each run by its table


class Damaged(dict[str, str]):
    """Reasons for leaving out runs, by run.

    Args:
        root: the folder above the runs.
        strict: raise the first reason.
    """

    def __init__(self, root: Path, strict: bool) -> None:
        super().__init__()
        self.root, self.strict = root, strict

    @contextmanager
    def noting(self, folder: Path) -> Iterator[None]:
        """Note errors that are raised while files of a run are read."""
        try:
            yield
        except ResultsError as error:
            if self.strict:
                raise
            log.warning("left out: %s", error)
            self[str(folder.relative_to(self.root))] = str(error)

    def unlisted(self, error: OSError) -> None:
        """Note a folder that cannot be listed."""
        with self.noting(folder := Path(error.filename)):
            raise ResultsError(f"{folder}: cannot be read: {error.strerror}")


@overload
def load(
    root: str | Path = ...,
    table: str = ...,
    settings: Sequence[str] | None = ...,
    *,
    strict: bool = ...,
    lazy: Literal[False] = ...,
) -> pd.DataFrame: ...


@overload
def load(
    root: str | Path = ...,
    table: str = ...,
    settings: Sequence[str] | None = ...,
    *,
    strict: bool = ...,
    lazy: Literal[True],
) -> Dataset: ...


def load(
    root: str | Path = "outputs",
    table: str = "episodes",
    settings: Sequence[str] | None = None,
    *,
    strict: bool = False,
    lazy: bool = False,
) -> Rows:
    """Read one table of every run below a folder.

    A damaged run is left out with a warning; ``frame.attrs["damaged"]`` holds the reasons by run,
    ``frame.attrs["unfinished"]`` the failed, stopped, running and waiting runs with their states,
    ``frame.attrs["missing"]`` the missing shards of an evaluation, and ``frame.attrs["repeated"]``
    the runs of equal settings, whose rows are all included, and ``frame.attrs["versions"]`` the
    runs by version of this package and hash of its code, if they differ. The episodes of a finished
    job of ``lcc-rl run`` are those of its evaluation, which includes its trainings.

    Args:
        root: a run folder, or any folder above runs.
        table: ``"episodes"``, ``"training"``, ``"timing"``, ``"steps"`` or ``"drivers"``.
        settings: settings that become columns, by dotted keys (``"seed"``, ``"agent.gamma"``) or
            patterns (``"reward.*"``, ``"*"``); by default ``"variant"``, ``"seed"`` and those in
            which the runs differ, also as typed in their commands (``"reward.without"``).
        strict: raise for a damaged, unfinished or repeated run or a missing shard.
        lazy: return a pyarrow dataset, which reads rows on demand, for tables that do not fit into
            memory.

    Returns:
        The rows of all runs, sorted by folder, with the column ``run`` and the chosen settings.
        Text is categorical.

    Raises:
        ConfigError: if the table or a setting is unknown.
        ResultsError: if no such table below ``root`` can be read.
    """
    require_known("table", table, TABLES)
    root = Path(root)
    damaged = Damaged(root, strict)
    states = unfinished(root) if root.is_dir() else {}
    if strict and states:
        raise ResultsError(f"{root}: not finished: {listed(states)}")
    runs, schema, own = _surveyed(root, table, damaged, states)
    constants = _chosen(runs, settings, schema.names)
    tables = {}
    if not lazy:
        for path in runs:
            with damaged.noting(path.parent):
                tables[path] = read_table(path, texts_of(own[path]))
        runs = {path: runs[path] for path in tables}
        if not runs:
            raise _nothing(root, table, damaged)
    states = {name: state for name, state in states.items() if name not in damaged}
    if states:
        log.warning("%s: not finished: %s", root, listed(states))
    missing = missing_shards(list(runs.values())) if table == "episodes" else []
    twice = repeated(list(runs.values()))
    for line in (*missing, *twice):
        if strict:
            raise ResultsError(f"{root}: {line}")
        log.warning("%s: %s", root, line)
    versions = of_versions(runs)
    for line in versions:
        log.warning("%s: %s", root, line)
    if lazy:
        return as_dataset(constants, schema)
    frame = _frame(tables, constants)
    noted = {"damaged": dict(damaged), "unfinished": states, "missing": missing}
    noted |= {"repeated": twice, "versions": versions}
    frame.attrs |= {name: value for name, value in noted.items() if value}
    return frame


def _files(root: Path, name: str, damaged: Damaged) -> list[Path]:
    """Return the files with a name in run folders at or below a folder, sorted."""
    paths = []
    for folder, folders, files in os.walk(root, onerror=damaged.unlisted):
        skipped = SUBFOLDERS if CONFIG in files else ()
        if PARTS in folders and Path(folder, FINAL, name).is_file():
            folders[:] = [FINAL]  # it includes the evaluations of its trainings
        folders[:] = [x for x in folders if not x.startswith(".") and x not in skipped]
        if name in files:
            paths.append(Path(folder, name))
    return sorted(paths)


def _surveyed(
    root: Path, table: str, damaged: Damaged, states: Mapping[str, str]
) -> tuple[Runs, pa.Schema, dict[Path, pa.Schema]]:
    """Return the settings of all runs with readable tables, their common and own columns."""
    runs, schemas = {}, {}
    for path in _files(root, f"{table}.parquet", damaged):
        with damaged.noting(path.parent):
            schema, config = schema_of(path, TABLES[table]), path.parent / CONFIG
            settings = flat_settings(config) if config.exists() else {}
            runs[path] = {"run": str(path.parent.relative_to(root)), **settings}
            schemas[path] = schema
    # Columns are those of most tables.
    common, columns, paths = Counter(map(str, schemas.values())), pa.schema([]), []
    for path in sorted(runs, key=lambda path: -common[str(schemas[path])]):
        with damaged.noting(path.parent):
            columns = unified(columns, schemas[path], path)
            paths.append(path)
    if not paths:
        raise _nothing(root, table, {**states, **damaged})
    return {path: runs[path] for path in sorted(paths)}, columns, schemas


def _chosen(runs: Runs, names: Sequence[str] | None, columns: Sequence[str]) -> Runs:
    """Return the settings that become columns, also those that became others, as typed."""
    wanted, differ = {*(names or ALWAYS)}, names is None and len(runs) > 1
    if differ or any(not wanted <= x.keys() for x in runs.values()):
        runs = {path: x | {**choices_of(path.parent), **x} for path, x in runs.items()}
    every = dict.fromkeys(key for settings in runs.values() for key in settings)
    for name in names or ():
        if not any(fnmatchcase(key, name) for key in every):
            every_one = f"settings=['*'] returns all {len(every)}.{nearest(name, [*every])}"
            raise ConfigError(f"unknown setting of these runs {name!r}; {every_one}")
    first = next(iter(runs.values()))

    def is_column(key: str) -> bool:
        if names is not None:
            return any(fnmatchcase(key, name) for name in names)
        return key in ALWAYS or any(run.get(key) != first.get(key) for run in runs.values())

    keys = [key for key in every if key == "run" or is_column(key)]
    of_one_type = {
        key: _of_one_type([run.get(key) for run in runs.values()])
        for key in keys
        if key not in columns
    }
    return {
        path: {key: values[index] for key, values in of_one_type.items()}
        for index, path in enumerate(runs)
    }


def _of_one_type(values: Sequence[Any]) -> list[Any]:
    """Return the values of a setting, as text if they have several types."""
    kinds = {type(value) for value in values} - {type(None)}
    if (kinds <= {int, float} and kinds) or len(kinds) == 1:
        return list(values)
    return [None if value is None else str(value) for value in values]


def _frame(parts: Mapping[Path, pa.Table], constants: Runs) -> pd.DataFrame:
    """Return tables with their constant columns as one data frame."""
    # Without the metadata of pandas, which may differ between tables, or be damaged.
    plain = (rows.replace_schema_metadata() for rows in parts.values())
    table = pa.concat_tables(plain, promote_options="permissive")
    counts = [len(rows) for rows in parts.values()]
    integers = {
        name: table[name].to_pandas(types_mapper=NULLABLE.get)
        for name in table.column_names
        if pa.types.is_integer(table[name].type) and table[name].null_count
    }
    first, columns = next(iter(constants.values())), {}
    for key in first:
        values = pd.Series([constants[path][key] for path in parts])
        values = values if is_numeric_dtype(values) else values.astype("category")
        columns[key] = values.repeat(counts).array
    frame = table.to_pandas(split_blocks=True, self_destruct=True)
    return pd.concat([frame.assign(**integers), pd.DataFrame(columns, copy=False)], axis=1)


def missing_shards(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a line for every evaluation with missing shards."""
    shards: dict[str, set[int]] = {}
    for settings in (x for x in runs if (x.get(SHARDS) or 1) > 1):
        shards.setdefault(_key(settings, SHARD), set()).add(settings[SHARD])
    lines = []
    for key, present in shards.items():
        settings = json.loads(key)
        gaps = sorted(set(range(settings[SHARDS])) - present)
        if gaps:
            which = ", ".join(map(str, gaps[:10])) + (", …" if len(gaps) > 10 else "")
            of = f"{len(gaps)} of {settings[SHARDS]} shards of variant {settings['variant']}"
            lines.append(f"{of} are missing: {SHARD}={which}")
    return lines


def repeated(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a line for all runs of equal settings."""
    groups: dict[str, list[str]] = {}
    for settings in runs:
        if settings.keys() - {"run"}:
            groups.setdefault(_key(settings), []).append(settings["run"])
    twice = (names for names in groups.values() if len(names) > 1)
    return [listed(dict.fromkeys(names, "runs of equal settings")) for names in twice]


def of_versions(runs: Runs) -> list[str]:
    """Return a line if tables are of several versions of this package, or of changed code."""
    written = {x["run"]: parquet_metadata(path).get(VERSION) for path, x in runs.items()}
    found = {run: f"lcc_rl {version}" for run, version in written.items() if version}
    return [f"rows of several versions: {listed(found)}"] * (len({*found.values()}) > 1)


def _key(settings: Mapping[str, Any], *without: str) -> str:
    """Return the settings of a run as text, without its folder."""
    kept = {key: value for key, value in settings.items() if key not in ("run", *without)}
    return json.dumps(kept, sort_keys=True, default=str)


def listed(reasons: Mapping[str, str]) -> str:
    """Return runs in words by the reasons why they have no rows."""
    groups: dict[str, list[str]] = {}
    for name, why in reasons.items():
        short = HASH.sub("", KEY.sub("", name))
        groups.setdefault(shorten(why, 100, placeholder=" …"), []).append(short)
    rest = " and {} more"
    return "; ".join(
        f"{', '.join(names[:MOST])}{rest.format(len(names) - MOST) * (len(names) > MOST)} ({why})"
        for why, names in groups.items()
    )


def _nothing(root: Path, table: str, reasons: Mapping[str, str]) -> ResultsError:
    why = f"; none is readable: {listed(reasons)}" if reasons else ""
    return ResultsError(f"{root}: no {table}.parquet in it or below it{why}")
