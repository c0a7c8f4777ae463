"""Exceptions for wrong input, with messages for the user."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from numbers import Integral


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


def require_positive(where: str, **settings: float) -> None:
    """Check settings of one piece or agent.

    Raises:
        ConfigError: naming the first that is not positive, as ``where.setting``.
    """
    for name, value in settings.items():
        if not value > 0:
            raise ConfigError(f"{where}.{name} must be positive, got {value}")


LARGEST_SEED = 2**32 - 1  # NumPy takes no larger ones


def require_whole(name: str, value: object, least: int, most: int | None = None) -> None:
    """Check a size, a count or a seed.

    Raises:
        ConfigError: naming the option unless the value is a whole number within the bounds.
    """
    if isinstance(value, Integral) and not isinstance(value, bool):
        number = int(value)
        if least <= number <= (number if most is None else most):
            return
    bounds = f"from {least} up" if most is None else f"from {least} to {most}"
    raise ConfigError(f"{name} must be a whole number {bounds}, got {value!r}")


def unknown_name(what: str, name: str, valid: Iterable[str]) -> ConfigError:
    """Build the error for an unknown name, listing the valid ones and the nearest."""
    options = sorted(valid)
    near = get_close_matches(name, options, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return ConfigError(f"unknown {what} {name!r}; valid: {', '.join(options) or 'none'}.{hint}")
