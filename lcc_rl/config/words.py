"""Words of a command line: overrides and the keys that they change."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

from lcc_rl.errors import ConfigError, require
from lcc_rl.settings import TARGET

YAML = (".yaml", ".yml")  # endings of files of controllers
DOTTED = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+")  # a class or function: my_pieces.PID
FILTERED = "_filtered"  # suffix of controllers behind the safety filter
RECORDED = "recorded"  # the recorded driver as a controller, or its value as a limit
SHOWN_AS = ("text", "markdown", "latex", "csv")  # formats of printed tables


def module_named(key: str, value: str) -> str:
    """Return the module that a setting names, itself or by a class or function; "" for none."""
    first, last = key.partition(".")[0], key.rpartition(".")[2]
    if first == "measures" or (last == TARGET and "." not in value):
        return value
    return value.rpartition(".")[0] if last in (TARGET, "law", "model") else ""


def key_of(override: str) -> str:
    """Return the dotted key that an override changes."""
    return override.lstrip("+~").split("=")[0]


def typed_keys(override: str) -> set[str]:
    """Return the dotted keys that an override sets; group and place of a choice, too.

    Examples:
        >>> sorted(typed_keys("+a.b={c: 1, d: x}"))
        ['a.b', 'a.b.c', 'a.b.d']
    """
    key, _, value = override.lstrip("+~").partition("=")
    inside = re.findall(r"(\w+)\s*:", value) if value.startswith("{") else []
    group, _, place = key.partition("@")
    return {group, place or group, *(f"{key}.{name}" for name in inside)}


def with_variant(variant: str, overrides: Any) -> list[Any]:
    """Return the words of a command from what a program gives; a text is one setting.

    Raises:
        ConfigError: for settings of folders, which Python ignores.
    """
    single = isinstance(overrides, str) or not isinstance(overrides, Iterable)
    words = [overrides] if single else [*overrides]
    for word in filter(re.compile("hydra.(run|sweep|job)").match, map(str, words)):
        raise ConfigError(f"{word} has no effect in Python: give folder=…")
    return [f"variant={variant}", *words]


def quoted(path: str | Path) -> str:
    """Return a path quoted for Hydra's command line."""
    return "'" + str(path).replace("\\", "\\\\").replace("'", "\\'") + "'"


def top_key(override: str) -> str:
    """Return the top-level key that an override changes."""
    return key_of(override).split(".")[0].split("@")[0]


def check_once(words: Sequence[str]) -> Sequence[str]:
    """Return the words of a command; refuse several values of a key, which Hydra allows."""
    first: dict[str, str] = {}
    for word in words:
        key, equals, value = word.removeprefix("++").partition("=")
        if equals and key[:1] not in "+~" and first.setdefault(key, value) != value:
            raise ConfigError(f"{key}={first[key]} {word}: {key} is set twice; leave one out")
    return words


def check_overrides(words: Sequence[str], given: Collection[str], reason: str) -> None:
    """Check that the remaining words of a command line are overrides.

    Args:
        words: the remaining words.
        given: keys that the command sets, such as ``data`` or ``scenario.string``.
        reason: why they cannot be given, for the message.

    Raises:
        ConfigError: naming the wrong word.
    """
    flags = [word for word in check_once(words) if word.startswith("-")]
    require(not flags, f"unknown flag {' '.join(flags)}; -h lists all flags")
    if any("=" not in word and word[:1] != "~" for word in words):
        raise ConfigError(f"expected overrides such as data=stream, got {' '.join(words)}")
    for word in words:
        for key in typed_keys(word):
            require(not {key, top_key(key)} & {*given}, f"{word}: {reason}")
        require(top_key(word) != "hydra", f"{word} has no effect: this command chooses the folders")
