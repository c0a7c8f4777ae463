"""What can be said about a page's command without running it."""

from __future__ import annotations

import argparse
import re
import runpy
import shlex
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from pathlib import Path
from unittest.mock import patch

import pytest
from commands import process_state
from hydra.core.override_parser.overrides_parser import OverridesParser
from pages import ROOT, Block, name_of

from lcc_rl.cli import console
from lcc_rl.config import load
from lcc_rl.errors import ConfigError

ENTRIES = {"run": "pipeline"}  # entry points that are not called as their command
SHELL = {"source", "export", "ls"}
MAKE = re.findall(r"^(\w[\w-]*):", (ROOT / "Makefile").read_text(), flags=re.M)
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
# Settings that a tool or command gives itself.
ALWAYS = {"tools/sumo_ring.py": ("task=ring-22",)}
PLACEHOLDER = re.compile(r"<[^<>=]*>…?|…")
LAUNCH = ("hydra/launcher=", "hydra/sweeper=")  # of extras that need not be installed
CHOICES = set((ROOT / "conf").rglob("*.yaml"))


class ParsedError(Exception):
    """Ends a command once its options are parsed; bears those that are left over."""


def check(words: Sequence[str], own: Path | None, fails: bool = False) -> None:
    """Check one command without running it.

    Args:
        words: the command; placeholders as ``<run>`` and ``…`` stand for names.
        own: folder of configuration files that the page tells to write.
        fails: whether the page shows the error that it ends with.
    """
    program, *rest = [PLACEHOLDER.sub("a_name", word) for word in words]
    if program == "make":
        assert next(word for word in rest if "=" not in word) in MAKE
    elif program == "pip":
        assert set(re.findall(r"\w+", rest[-1].strip("'\""))) <= set(EXTRAS), rest
    elif program.endswith("python"):
        assert (ROOT / rest[0]).exists(), rest[0]
        settings = parsed(rest[0], rest[1:]) if rest[1:] else []
        typed = (word for word in settings if "=" in word)
        once("train", (*ALWAYS.get(rest[0], ()), *typed))
    elif program == "lcc-rl" and rest and rest[0] in console.HYDRA:
        composed(ENTRIES.get(rest[0], rest[0]), rest[1:], own, fails)
    elif program == "lcc-rl":
        assert rest[0] in {*console.COMMANDS, "-h"}
        if len(rest) > 1 and "--help" not in rest:
            settings = parsed(None, rest)
            typed = (word for word in settings if "=" in word)
            once("train", (*ALWAYS.get(rest[0], ()), *typed))
    else:
        assert program in SHELL, f"what is {program}?"


def composed(entry: str, words: Sequence[str], own: Path | None, fails: bool) -> None:
    """Compose the first and the last run of a command of Hydra."""
    settings = settings_of(words, own)
    ends = ([one_run(item, choice) for item in settings] for choice in (0, -1))
    with suppress(ConfigError) if fails else nullcontext():
        for run in dict.fromkeys(map(tuple, ends)):
            once(entry, run)


@cache
def once(entry: str, settings: tuple[str, ...]) -> None:
    """Compose settings; a command in the text may leave out a required one."""
    try:
        load(entry, settings)
    except ConfigError as error:
        if "is required" not in str(error):
            raise


def settings_of(words: Sequence[str], own: Path | None) -> list[str]:
    """Return the settings among the words of a command of Hydra, without those of launchers."""
    settings = [word for word in words if "=" in word or word.startswith("~")]
    flags = [word for word in words if word not in settings]
    for word in settings:
        if word.startswith(LAUNCH):
            assert ROOT / "conf" / f"{word.replace('=', '/')}.yaml" in CHOICES
    settings = [word for word in settings if not word.startswith(LAUNCH)]
    if flags[:1] == ["--config-dir"] and own is not None:
        settings.append(f"hydra.searchpath=[file://{own / flags[1]}]")
        flags = flags[2:]
    assert set(flags) <= {"-m", "--help"}, flags
    return settings


def one_run(setting: str, choice: int) -> str:
    """Return one value of a setting that may be swept."""
    (override,) = OverridesParser.create().parse_overrides([setting])
    if not override.is_sweep_override():
        return setting
    values = list(override.sweep_string_iterator())
    return f"{override.get_key_element()}={values[choice]}"


def parsed(tool: str | None, words: Sequence[str]) -> list[str]:
    """Let a tool, or else a command of lcc-rl, parse its options; return what is left over."""
    original, outer = argparse.ArgumentParser.parse_known_args, []

    def known(parser, args=None, namespace=None):
        if outer:  # a subcommand of it
            return original(parser, args, namespace)
        outer.append(parser)
        raise ParsedError(*original(parser, args, namespace)[1])

    def exact(parser, args=None, namespace=None):
        outer.append(parser)
        others = original(parser, args, namespace)[1]
        assert not others, f"unknown: {others}"
        raise ParsedError

    parser = argparse.ArgumentParser
    with (
        patch.object(parser, "parse_known_args", known),
        patch.object(parser, "parse_args", exact),
        process_state(tool or "lcc-rl", tuple(words), ROOT),
    ):
        try:
            if tool is None:
                console.main(list(words))
            else:
                runpy.run_path(str(ROOT / tool), run_name="__main__")
        except ParsedError as end:
            return list(end.args)
    raise AssertionError(f"{tool or 'lcc-rl'} has no parser of options")


def write_configuration(page: Sequence[Block], folder: Path) -> Path:
    """Write the configuration files that a page tells to write; return the folder."""
    for block in page:
        if block.language == "yaml":
            path = folder / block.before.strip("`:")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text)
    return folder


@contextmanager
def named(page: Path, line: int, words: Sequence[str]) -> Iterator[None]:
    """Name the command in the message of whatever goes wrong."""
    try:
        yield
    except (Exception, SystemExit) as error:
        place = f"{name_of(page)}:{line}" if line else name_of(page)
        pytest.fail(f"{place}: {shlex.join(words)}: {type(error).__name__}: {error}", pytrace=False)
