"""Exceptions for wrong input with messages for users."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from difflib import get_close_matches
from numbers import Real
from pathlib import Path
from sysconfig import get_path
from traceback import walk_tb
from typing import Any


class LccError(Exception):
    """Base class of errors caused by input: a file, a row, a key or an option."""

    def __str__(self) -> str:
        """Return the message without control characters."""
        text = super().__str__()
        return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


class DataError(LccError, ValueError):
    """A file of trajectories, profiles or drivers is not valid."""


class ConfigError(LccError, ValueError):
    """A setting is unknown, impossible or contradicts another setting."""


class ResultsError(LccError, RuntimeError):
    """A result, policy or checkpoint file is missing, damaged or of another version."""


class Concern(str):
    """A line of a report on a condition that changes results; it is shown first."""


class Interrupted(LccError):
    """A job was stopped by the user after saving its state."""


class Diverged(LccError):
    """An action, a state, a reward, an energy or a loss is not a finite number.

    Args:
        what: the value, with place and time.
        advice: the remedy.
    """

    def __init__(self, what: str, advice: str = "") -> None:
        super().__init__(f"{what}. {advice}" if advice else what)
        self.what, self.advice = what, advice


# Exceeds all quantities of traffic and learning; its square is finite in single precision.
LARGEST = 1e9
# Exceeds any memory, which has its own error; and the largest seed.
LARGEST_SIZE, LAST_SEED = 10**15, 2**32 - 1  # torch uses no more bits of a seed
REMEDIES = {  # of a user's code, by words of torch's errors
    "Boolean value": "use torch.where in place of if",
    "converted to": "use torch in place of math and float: this is a tensor of several numbers",
}
# Folders of code that is not the user's: package, tools of a clone, Python.
NOT_USERS = (Path(__file__).parent, Path(__file__).parents[1] / "tools", get_path("stdlib"))


def require(condition: object, message: str) -> None:
    """Raise a ConfigError with the message unless the condition holds."""
    if not condition:
        raise ConfigError(message)


def require_positive(what: str, value: Any) -> None:
    """Raise a ConfigError unless the value is a positive number of plausible size."""
    number = isinstance(value, Real) and not isinstance(value, bool)
    if not (number and 0.0 < value <= LARGEST):
        raise ConfigError(f"{what} must be a positive, finite number, got {value!r}")


@contextmanager
def raised_as(kind: type[LccError], words: str, *caught: type[Exception]) -> Iterator[None]:
    """Raise caught errors as one of this package: the words, then their message in one line."""
    try:
        yield
    except caught as error:
        raise kind(f"{words}: {line_of(error)}".removeprefix(": ")) from error


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


def place_of(error: BaseException) -> str:
    """Return file and line of the user's code in which an error was raised, or nothing."""
    place = ""
    for frame, line in walk_tb(error.__traceback__):
        file = frame.f_code.co_filename
        place = f"{file}:{line}" if is_users(frame.f_globals.get("__name__", ""), file) else place
    return place


def line_of(error: BaseException, typed: bool = False) -> str:
    """Return an error in one line; one of a user's code, or if ``typed``, with its type."""
    if isinstance(error, LccError):
        return one_line(str(error))
    text, place = one_line(str(error))[:500], place_of(error)
    text = f"{type(error).__name__}: {text}" if typed or place else text
    remedy = "".join(f" ({remedy})" for words, remedy in REMEDIES.items() if words in text)
    return f"{text} ({place}){remedy}" if place else text


@contextmanager
def replacing(
    other: Callable[[Exception], LccError | None], caught: Any = Exception
) -> Iterator[None]:
    """Raise errors of other code as those that a function returns; it returns None to keep one."""
    try:
        yield
    except LccError:
        raise
    except caught as error:
        if (found := other(error)) is None:
            raise
        raise found from error


def naming(title: str) -> AbstractContextManager[None]:
    """Raise an error of a user's code as a ConfigError: its class, then the error's type, line."""

    def named(error: Exception) -> LccError | None:
        return ConfigError(f"{title} fails: {line_of(error)}") if place_of(error) else None

    return replacing(named)


def needing(extra: str, words: str) -> AbstractContextManager[None]:
    """Raise a ConfigError with the commands that install an extra if an import fails."""
    text = f"{words}: {how_to_install(extra)}"
    return replacing(lambda error: ConfigError(f"{text} ({error})"), ImportError)


def how_to_install(extra: str) -> str:
    """Return the commands that install an extra of this package, from a clone or a wheel."""
    return f"pip install -e '.[{extra}]', or '<wheel>[{extra}]' where there is no clone"


def unknown_name(what: str, name: str, valid: Iterable[str]) -> ConfigError:
    """Return the error for an unknown name with the valid names and the nearest one."""
    known = sorted(valid)
    hint = nearest(name, known)
    return ConfigError(f"unknown {what} {name!r}; valid: {', '.join(known) or 'none'}.{hint}")


def nearest(name: str, options: Sequence[str]) -> str:
    """Return the question whether the nearest option is meant, or nothing."""
    near = get_close_matches(name, options, n=1)
    return f" Did you mean {near[0]!r}?" if near else ""


def require_known(what: str, names: str | Iterable[Any], valid: Iterable[str]) -> None:
    """Raise the error of :func:`unknown_name` for a name, or the first of several, if unknown."""
    valid = list(valid)
    for name in [names] if isinstance(names, str) else names:
        if name not in valid:
            raise unknown_name(what, str(name), valid)


def out_of_memory(error: BaseException) -> bool:
    """Whether an allocation failed in NumPy, pyarrow or torch."""
    text = str(error)
    return isinstance(error, MemoryError) or "t allocate memory" in text or "out of memory" in text


def of_hydra(error: BaseException) -> bool:
    """Whether an error is one of Hydra or OmegaConf, which need not be loaded."""
    kinds = type(error).__mro__
    return any(kind.__module__.startswith(("hydra.", "omegaconf.")) for kind in kinds)


def input_error(error: BaseException) -> LccError | None:
    """Return the error of this package that another error wraps."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, LccError):
        # OmegaConf sets its resolvers' errors as context, not as cause.
        cause = cause.__cause__ or (cause.__context__ if of_hydra(cause) else None)
    return cause


def in_short(value: Any, most: int = 80) -> str:
    """Return the representation of a value in one line, cut to some characters."""
    return one_line(repr(value))[:most]


def one_line(text: str) -> str:
    """Return a text in one line without control characters."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())
