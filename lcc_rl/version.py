"""The package: its version, and whether code is of it or a user's."""

from __future__ import annotations

import hashlib
import sys
from functools import cache
from pathlib import Path
from sysconfig import get_path
from typing import Any

__version__ = "0.3.0"
PACKAGE = Path(__file__).parent
# Folders with code that is not the user's: package, tools of a clone, Python.
NOT_USERS = (PACKAGE, PACKAGE.parent / "tools", get_path("stdlib"))


@cache
def code_version() -> str:
    """Return the version with a hash of the package's modules, which tells edited clones apart."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(PACKAGE).as_posix().encode() + path.read_bytes())
    return f"{__version__}+{digest.hexdigest()[:8]}"


def is_ours(path: Any) -> bool:
    """Whether a module, class or function is of this package, by its dotted path."""
    return f"{path}.".startswith("lcc_rl.")


def is_users(module: str, file: str | Path) -> bool:
    """Whether a module is not of this project, Python or an installed package.

    A module in a package belongs to the owner of the package: compilers store such modules in
    folders of their own.

    Args:
        module: its dotted path, or ``__main__``.
        file: its file.
    """
    outermost, inside, _ = module.partition(".")
    whole = getattr(sys.modules.get(outermost), "__file__", None) if inside else None
    path = Path(whole or file)
    installed = {"site-packages", "dist-packages"}.intersection(path.parts)
    other = any(path.is_relative_to(folder) for folder in NOT_USERS) or str(path)[:1] == "<"
    return not (installed or other)
