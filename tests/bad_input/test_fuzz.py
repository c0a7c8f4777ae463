"""Random overrides and tables end in a result or in an error of the package, within bounds.

A long run: ``FUZZ=5000 pytest tests/bad_input/test_fuzz.py``.
"""

from __future__ import annotations

import gzip
import os
import resource
import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from commands import DATA, process_state
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ngsim_text import csv_text, pair, portal_text
from table_text import READERS, long_table, openacc_text, pairs

import lcc_rl.conf
from lcc_rl.commands import evaluation, training
from lcc_rl.config import load
from lcc_rl.config.schemas import as_plain
from lcc_rl.data.sources import LoadedEpisodes
from lcc_rl.errors import LccError, out_of_memory
from lcc_rl.io import memory

EXAMPLES = int(os.environ.get("FUZZ", "4"))
SECONDS, GIGABYTES = 60.0, 6  # of a case
CONF = Path(lcc_rl.conf.__path__[0])
CHOICES = {
    folder.name: sorted(path.stem for path in folder.glob("*.yaml"))
    for folder in sorted(CONF.iterdir())
    if folder.is_dir() and folder.name not in ("hydra", "logger", "__pycache__")
}
SMALL = ("experiment=smoke", "scenario.horizon=20")
RECIPES = (
    *("", "", "+filter=cbf", "+knowledge=memory", "+knowledge=preview", "scenario=ring agent=none"),
    *("agent=td3", "agent=sac", "agent=analytic", "agent=none", "drivers=fixed"),
    *("split.by=vehicle", "split=single", "experiment=single_profile", "leader=trajectories"),
    *("scenario.string=automated*2", "scenario.string={size:6,penetration:0.3}"),
    "controller@scenario.controllers.automated=handover",
)
# Files, folders, foreign code and machines are the business of other tests.
FOREIGN = ("_target_", "path", "policy", "resume", "sweep", "keep", "device", "compiled", "trust")
FACTORS = (-1, 0, 1e-9, 1e-3, 0.3, 0.9, 0.95, 1.05, 1.1, 2, 10, 1e4, 1e12)
COUNTS = (-1, 0, 0.3, 0.9, 1.1, 2, 1e12)  # 10,000 times as many episodes take hours
VALUES = (
    *("nan", "inf", "-inf", "-1", "0", "1", "0.5", "-0.0", "1e30", "-1e30", "1e-30", "1e9"),
    *("2147483647", "99999999999999999999999", "1" + "0" * 400, "true", "false", "null", "''"),
    *("abc", "größe", "[]", "{}", "[1]", "[1,2,3]", "[nan,1]", "[a,b]", "[[1],[2]]", "{a: 1}"),
    *("{a: {b: nan}}", "${seed}", "${nowhere}", "${scenario}", "${oc.env:NOBODY}", "???", "'???'"),
    *("'a b'", "random", "first", "self", "automated", "human", "vehicles", "automated*2"),
)


@cache
def keys_of(variant: str) -> dict[str, Any]:
    """Return the values of a variant's configuration by dotted keys, those of nodes, too."""
    cfg = as_plain(load("train", [f"variant={variant}"]))
    unused = ("data", "split") if cfg.get("leader") is not None else ()
    found, left = {}, list(cfg.items())
    while left:
        key, value = left.pop(0)
        if {*key.split(".")} & {*FOREIGN} or key in unused:
            continue
        found[key] = value
        if isinstance(value, dict):
            left = [(f"{key}.{name}", x) for name, x in value.items()] + left
    return found


def overrides_of(variant: str) -> st.SearchStrategy[str]:
    """Return random overrides of a variant: mostly numbers, changed little or far."""
    known = keys_of(variant)
    plain = {key: value for key, value in known.items() if type(value) in (int, float)}
    numbers = [
        f"{key}={type(value)(value * factor)!r}"
        for key, value in plain.items()
        for factor in (COUNTS if isinstance(value, int) else FACTORS)
    ]
    key, plus = st.sampled_from(list(known)), st.sampled_from(("", "", "+", "++", "~"))
    end = st.sampled_from(("", "", "", "x", ".more", ".weight"))
    value = st.builds("{}{}{}={}".format, plus, key, end, st.sampled_from(VALUES))
    at = st.sampled_from(("", "", "@scenario.controllers.automated", "@deployed"))
    names = [(group, name) for group, some in CHOICES.items() for name in (*some, "nobody", "null")]
    choice = st.builds(
        lambda plus, at, pair: f"{plus}{pair[0]}{at}={pair[1]}", plus, at, st.sampled_from(names)
    )
    return st.one_of(*[st.sampled_from(numbers)] * 4, value, choice)


@st.composite
def commands(draw: Any) -> tuple[str, list[str]]:
    """Draw a command and its words."""
    variant, recipe = draw(st.sampled_from(CHOICES["variant"])), draw(st.sampled_from(RECIPES))
    data = DATA if "data" in keys_of(variant) and "ring" not in recipe else ()
    typed = draw(st.lists(overrides_of(variant), min_size=1, max_size=3))
    words = [f"variant={variant}", *SMALL, *data, *recipe.split(), *typed]
    return draw(st.sampled_from(("train", "train", "train", "evaluate"))), words


@contextmanager
def limited(seconds: float = SECONDS) -> Iterator[None]:
    """Limit the time and the memory of what runs inside, and put back what it changes.

    The time is the processor's; on a busy machine it may take ten times as long.
    """

    def stop(*_: object) -> None:
        raise TimeoutError(f"longer than {seconds} s")

    def free(device: object = "cpu") -> int:
        return GIGABYTES << 29  # half: torch and its libraries take their part

    clocks = {signal.ITIMER_PROF: signal.SIGPROF, signal.ITIMER_REAL: signal.SIGALRM}
    before = resource.getrlimit(resource.RLIMIT_DATA)
    handlers = {kind: signal.signal(kind, stop) for kind in clocks.values()}
    signal.setitimer(signal.ITIMER_PROF, seconds)
    signal.setitimer(signal.ITIMER_REAL, 10 * seconds)
    resource.setrlimit(resource.RLIMIT_DATA, (GIGABYTES << 30, before[1]))
    try:
        with process_state("fuzz", (), Path.cwd()), patch.object(memory, "available", free):
            warnings.simplefilter("ignore")
            yield
    finally:
        for clock in clocks:
            signal.setitimer(clock, 0)
        for kind, handler in handlers.items():
            signal.signal(kind, handler)
        resource.setrlimit(resource.RLIMIT_DATA, before)


fuzzed = settings(
    max_examples=EXAMPLES,
    derandomize="FUZZ" not in os.environ,
    database=None,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)


def test_random_overrides_work_or_are_refused() -> None:
    ends = []

    @fuzzed
    @given(commands())
    def attempt(command: tuple[str, list[str]]) -> None:
        entry, words = command
        try:
            with limited(), TemporaryDirectory() as folder:
                run = training.run if entry == "train" else evaluation.run
                run(load(entry, words), Path(folder) / "run", quiet=True)
            ends.append("works")
        except LccError as error:
            ends.append("refused" if str(error).strip() else "refused without words")
        except (MemoryError, RuntimeError) as error:  # what the command line says in one line
            if not out_of_memory(error):
                raise
            ends.append("refused")

    attempt()
    assert {*ends} == {"works", "refused"}


LONG = long_table(rows=60, step=0.5)  # small, for a failure prints it
RECORDS = long_table(rows=60).rename(columns={"id": "drive", "t": "time_s", "v": "speed_mps"})
TABLES = {
    "ngsim": csv_text(pair(range(60))),
    "source": csv_text(pair(range(200))),
    "i-80": portal_text(pair(range(60))),
    "table": LONG.to_csv(index=False),
    "episodes": pairs(5).to_csv(index=False),
    "openacc": openacc_text(2, 200),
    "drives": RECORDS.to_csv(index=False),
    "record": RECORDS.iloc[:60].to_csv(index=False),
}
CELLS = (
    *("", " ", "nan", "inf", "-inf", "1e400", "1e20", "-1", "0", "1", "0.05", "99999999999"),
    *("abc", "größe", '"', "'", "1;2", "=1+1", "0x10", "1e", "--", "\t", "\r", "\0", "TRUE"),
)
SIGNS = ((",", ";"), (",", "\t"), (",", " "), ("\n", "\r\n"), ("\n", "\r"), (".", ","), ("0", ""))


@st.composite
def tables(draw: Any) -> tuple[str, bytes]:
    """Draw a reader and a table of its own with up to three faults."""
    reader = draw(st.sampled_from(list(TABLES)))
    text = TABLES[reader]
    for _ in range(draw(st.integers(0, 3))):
        lines = text.split("\n")
        first, last = sorted(draw(st.integers(0, len(lines) - 1)) for _ in range(2))
        column, cell = draw(st.integers(0, 17)), draw(st.sampled_from(CELLS))
        end = draw(st.sampled_from((first + 1, last + 1, len(lines))))

        def replaced(line: str, column: int = column, cell: str = cell) -> str:
            cells = line.split(",")
            return ",".join([*cells[:column], cell, *cells[column + 1 :]])

        def without(line: str, column: int = column) -> str:
            cells = line.split(",")
            return ",".join(cells[:column] + cells[column + 1 :])

        here = lines[first:end]
        change: list[str] = draw(
            st.sampled_from(
                (
                    *([replaced(line) for line in here],) * 3,
                    [without(line) for line in here],
                    [line + "," + line for line in here],
                    here[::-1],
                    here * 2,
                    [],
                )
            )
        )
        text = "\n".join(lines[:first] + change + lines[end:])
        if draw(st.integers(0, 9)) == 0:
            text = text.replace(*draw(st.sampled_from(SIGNS)))
    content = text.encode()
    cut = draw(st.sampled_from((len(content),) * 9 + (len(content) // 2, 100, 1)))
    coded = draw(st.sampled_from((bytes,) * 9 + (gzip.compress,)))
    return reader, coded(content[:cut])


def test_random_tables_are_read_or_refused() -> None:
    ends = []

    @fuzzed
    @given(tables())
    def attempt(table: tuple[str, bytes]) -> None:
        reader, content = table
        refused, read = "", None
        with limited(), TemporaryDirectory() as folder:
            path = Path(folder) / "table.csv"
            path.write_bytes(content)
            try:
                read = READERS[reader](str(path))
            except LccError as error:
                refused = str(error)
        if read is None:
            assert "table.csv" in refused
            assert all(line.isprintable() for line in refused.split("\n")), refused
            ends.append("refused")
        else:
            if isinstance(read, LoadedEpisodes):
                numbers = read.episodes.select_dtypes("number")
                assert len(numbers)
                assert np.isfinite(numbers.to_numpy()).all()
            ends.append("works")

    attempt()
    assert {*ends} == {"works", "refused"}


def test_hangs_and_too_much_memory_are_failures() -> None:
    with pytest.raises(TimeoutError), limited(seconds=0.1):
        signal.pause()
    with pytest.raises(RuntimeError, match="can't allocate memory"), limited():
        torch.ones(3 << 30)
