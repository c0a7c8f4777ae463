"""Put small faults into the package one by one and report whether the tests catch each.

    python tools/mutants.py                                           # all faults
    python tools/mutants.py idm-root hcfs-cap --tests tests/functional --out mutants.csv

tools/mutants.toml lists the faults. Each is applied to a copy of the tree, where the tests nearest
to it run first and the whole suite only if these pass; --tests runs other tests instead of both.
A test that also fails without a fault has caught nothing. The exit code is 1 if a fault survives.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

ROOT = Path(__file__).resolve().parents[1]
LIST = Path(__file__).with_suffix(".toml")
FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+?(?:\[.*?\])?)(?: - |$)", re.MULTILINE)
PYTEST = ("-x", "-q", "-m", "not slow")
PASSED, CAUGHT = 0, 1  # exit codes of pytest


@dataclass(frozen=True)
class Mutant:
    """A small fault.

    Args:
        name: as on the command line.
        file: a module of ``lcc_rl/``; the copy shares ``conf/`` with the tree.
        text: what is replaced; occurs exactly once in the file.
        fault: what replaces it.
        breaks: what is wrong then.
        tests: the tests nearest to it.
    """

    name: str
    file: str
    text: str
    fault: str
    breaks: str
    tests: list[str]

    def applied(self, source: str) -> str:
        """Return the file's content with the fault."""
        count = source.count(self.text)
        if count != 1 or self.fault == self.text:
            raise ValueError(f"{self.name}: {self.text!r} occurs {count} times in {self.file}")
        return source.replace(self.text, self.fault)


def mutants() -> dict[str, Mutant]:
    """Return the listed faults by name."""
    return {
        name: Mutant(name, **entry)
        for name, entry in tomllib.loads(LIST.read_text(encoding="utf-8")).items()
    }


class Copy:
    """A copy of the tree as it is, with what is not committed, in a folder of its own.

    Args:
        folder: where; the compiled simulation of drivers is cached there, too.
    """

    def __init__(self, folder: Path) -> None:
        self.tree, cache = folder / "tree", folder / "cache"
        words = ("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard")
        listed = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
        for name in filter(None, listed.split("\0")):
            if (ROOT / name).is_file():
                (self.tree / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, self.tree / name)
        # The test of the list would miss there what a fault has replaced.
        (self.tree / LIST.relative_to(ROOT)).write_text("", encoding="utf-8")
        own = {"PYTHONPATH": str(self.tree), "XDG_CACHE_HOME": str(cache), "OMP_NUM_THREADS": "1"}
        self.environment = {**os.environ, **own}

    def first_failure(self, tests: Sequence[str]) -> str:
        """Run tests until one fails; return its id, or nothing if all pass."""
        done = subprocess.run(
            [sys.executable, "-m", "pytest", *PYTEST, *tests],
            cwd=self.tree,
            env=self.environment,
            capture_output=True,
            text=True,
        )
        failed = FAILED.search(done.stdout)
        if done.returncode == CAUGHT and failed:
            return failed[1]
        if done.returncode != PASSED:
            raise RuntimeError(f"pytest {shlex.join(tests)}: {done.stdout[-2000:]}{done.stderr}")
        return ""

    def judge(self, mutant: Mutant, stages: Sequence[Sequence[str]]) -> dict[str, Any]:
        """Apply a fault, run the tests of each stage until one fails, and take the fault out.

        Returns:
            The row of the fault: its name, file and effect, the first test that failed (empty if
            the fault survived), whether a test nearest to it found it, and the seconds.
        """
        path, begun, test = self.tree / mutant.file, time.monotonic(), ""
        plain = path.read_text(encoding="utf-8")
        path.write_text(mutant.applied(plain), encoding="utf-8")
        try:
            for tests in stages:
                test = test or self.first_failure(tests)
        finally:
            path.write_text(plain, encoding="utf-8")
        row = {"name": mutant.name, "file": mutant.file, "breaks": mutant.breaks, "test": test}
        nearest = bool(test) and any(test.startswith(name) for name in mutant.tests)
        return {**row, "nearest": nearest, "seconds": time.monotonic() - begun}


def run(chosen: Sequence[Mutant], tests: Sequence[str] | None, out: Path | None) -> bool:
    """Judge faults and print what caught them; return whether all are caught."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        for mutant in chosen:
            row = copy.judge(mutant, [mutant.tests, ()] if tests is None else [tests])
            result = f"caught by {row['test']}" if row["test"] else f"SURVIVED: {mutant.breaks}"
            print(f"{mutant.name:<18} {row['seconds']:4.0f} s  {result}", flush=True)
            rows.append(row)
        failing = list(dict.fromkeys(row["test"] for row in rows if row["test"]))
        while failing and (test := copy.first_failure(failing)):
            print(f"{test} fails without a fault, too", flush=True)
            failing.remove(test)
    table = pd.DataFrame(rows)
    table["test"] = table["test"].where(table["test"].isin(failing), "")
    if out is not None:
        table.to_csv(out, index=False)
    survivors = table.loc[table["test"] == "", "name"].tolist()
    caught = f"{len(table) - len(survivors)} of {len(table)} caught"
    print(caught, *survivors, sep="; not " if survivors else "")
    return not survivors


def main(arguments: Sequence[str] | None = None) -> int:
    """Judge the faults given on the command line, or all."""
    known = mutants()
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("names", nargs="*", metavar="name", help=", ".join(known))
    parser.add_argument("--tests", type=shlex.split, help="arguments of pytest")
    parser.add_argument("--out", type=Path, help="write the verdicts to this .csv file")
    options = parser.parse_args(arguments)
    for name in options.names:
        if name not in known:
            parser.error(f"unknown fault {name}; valid: {', '.join(known)}")
    chosen = [known[name] for name in options.names or known]
    return 0 if run(chosen, options.tests, options.out) else 1


if __name__ == "__main__":
    sys.exit(main())
