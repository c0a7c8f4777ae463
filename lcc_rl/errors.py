"""Exceptions for wrong input, with messages for the user."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from numbers import Integral, Real
from typing import Any


class LccError(Exception):
    """Base class of errors caused by input: a file, a row, a key or an option."""


class DataError(LccError, ValueError):
    """A trajectory, profile or driver file is not what was expected."""


class ConfigError(LccError, ValueError):
    """A setting is unknown, impossible or contradicts another setting."""


class ResultsError(LccError, RuntimeError):
    """A result, policy or checkpoint file is missing, damaged or of another version."""


class Interrupted(LccError):
    """A job was stopped by the user after saving its state."""


class Diverged(LccError):
    """An action, a state, a reward, an energy or a loss is not a finite number.

    Args:
        what: which one, where and when.
        advice: what to do about it.
    """

    def __init__(self, what: str, advice: str = "") -> None:
        super().__init__(f"{what}. {advice}" if advice else what)
        self.what, self.advice = what, advice


# Far beyond every quantity of traffic and learning; its square is a number in single precision.
LARGEST = 1e9
# Far beyond what fits into memory, which is said with what is needed; and seeds.
LARGEST_SIZE, LAST_SEED = 10**15, 2**31 - 1
WORDS = {
    "(-inf, inf)": "be a number",
    "(0, inf)": "be positive",
    "[0, inf)": "not be negative",
}


def require(condition: bool, message: str) -> None:
    """Raise a ConfigError with the message unless the condition holds."""
    if not condition:
        raise ConfigError(message)


def require_in(where: str, interval: str, **settings: Any) -> None:
    """Check that settings of one piece or agent are numbers in an interval.

    Args:
        where: what has the settings: their place in the configuration.
        interval: an interval such as ``"[0, 1)"``; with an infinite end it reaches to
            :data:`LARGEST`.
        **settings: the values by name.

    Raises:
        ConfigError: naming the first that is no number, not finite or outside, as
            ``where.setting``.

    Examples:
        >>> require_in("agent", "[0, 1)", gamma=0.9)
    """
    low, high = (float(end) for end in interval[1:-1].split(","))
    for name, value in settings.items():
        number = isinstance(value, Real) and not isinstance(value, bool)
        bounded = number and abs(value) <= LARGEST
        if (
            bounded
            and (low < value or (interval[0] == "[" and value == low))
            and (value < high or (interval[-1] == "]" and value == high))
        ):
            continue
        wanted = WORDS.get(interval, f"lie in {interval}")
        if interval in WORDS and not bounded:
            wanted += f", and a finite number up to {LARGEST:g}"
        raise ConfigError(f"{where}.{name} must {wanted}, got {value!r}")


def require_positive(where: str, **settings: Any) -> None:
    """Check that settings of one piece or agent are positive numbers; see :func:`require_in`."""
    require_in(where, "(0, inf)", **settings)


def require_whole(where: str, least: int, most: int | None = None, **settings: Any) -> None:
    """Check that settings are whole numbers in a range: sizes, counts and seeds.

    Args:
        where: what has the settings; empty for options that belong to nothing.
        least, most: the range; without ``most`` up to :data:`LARGEST_SIZE`.
        **settings: the values by name.

    Raises:
        ConfigError: naming the first that is not, as ``where.setting``.
    """
    last = LARGEST_SIZE if most is None else most
    for name, value in settings.items():
        whole = isinstance(value, Integral) and not isinstance(value, bool)
        if not (whole and least <= value <= last):
            key = f"{where}.{name}" if where else name
            small = most is None and not (whole and value > last)
            bounds = f"from {least} up" if small else f"from {least} to {last}"
            raise ConfigError(f"{key} must be a whole number {bounds}, got {value!r}")


def how_to_install(extra: str) -> str:
    """Say how an extra of this package is installed, in a clone or from a wheel."""
    return f"pip install -e '.[{extra}]', or '<wheel>[{extra}]' where there is no clone"


def unknown_name(what: str, name: str, valid: Iterable[str]) -> ConfigError:
    """Build the error for an unknown name, listing the valid ones and the nearest."""
    options = sorted(valid)
    near = get_close_matches(name, options, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return ConfigError(f"unknown {what} {name!r}; valid: {', '.join(options) or 'none'}.{hint}")
