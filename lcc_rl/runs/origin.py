"""Where a run comes from: its command, the versions, and the commit of the user's own folder."""

from __future__ import annotations

import platform
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

from lcc_rl.version import __version__

ORIGIN = "origin.txt"


def origin() -> str:
    """Return the lines of ``origin.txt``: command, versions, folder and its commit, if it has one.

    It is no part of a run's identity; the settings and the hashes of its files are in config.yaml.
    """
    program = [Path(sys.argv[0]).name, *sys.argv[1:]]
    versions = f"lcc_rl {__version__}, torch {version('torch')}, Python {platform.python_version()}"
    return "\n".join([shlex.join(program), versions, f"{Path.cwd()}{_commit()}", ""])


def _commit() -> str:
    """Return the commit of the working directory, and how many of its files differ from it."""
    commit, changed = _git("rev-parse", "HEAD"), _git("status", "--porcelain")
    if not commit:
        return ""
    count = len((changed or "").splitlines())
    return f", commit {commit.strip()}, {f'{count} files changed' if count else 'unchanged'}"


def _git(*words: str) -> str:
    # A monitor of file systems is a program that the repository names.
    command = ["git", "-c", "core.fsmonitor=false", *words]
    try:
        found = subprocess.run(command, capture_output=True, text=True, timeout=5.0, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return found.stdout if found.returncode == 0 else ""
