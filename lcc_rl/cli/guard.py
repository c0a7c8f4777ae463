"""Streams, signals, exit codes and one-line errors of all commands."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from typing import Any, NoReturn

from lcc_rl.errors import (
    Interrupted,
    input_error,
    line_of,
    of_hydra,
    one_line,
    out_of_memory,
    place_of,
)
from lcc_rl.runs.interrupts import BAD_INPUT, INTERRUPTED, interruptible
from lcc_rl.runs.output import unbroken_output

# Settings of trainings and evaluations on which the memory depends.
SMALLER = "training.environments, agent.buffer_size, agent.batch_size or evaluation.batch_size"


def main_guard(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a function as a command with streams, signals and exit codes.

    Wrong input (this package's errors, Hydra's, OSError), an error in a user's code and too little
    memory give one line on stderr and exit code 2, an interrupt exit code 130, any other error its
    traceback and exit code 1. Commands may be nested.
    """

    @wraps(function)
    def guarded(*arguments: Any, **settings: Any) -> Any:
        try:
            with unbroken_output(), interruptible() as interrupted:
                try:
                    return function(*arguments, **settings)
                except Exception as error:
                    if interrupted.is_set() and not isinstance(input_error(error), Interrupted):
                        raise KeyboardInterrupt from error
                    raise
        except KeyboardInterrupt:
            stop("interrupted", INTERRUPTED)
        except Exception as error:
            cause = input_error(error)
            if isinstance(cause, Interrupted):
                stop(str(cause), INTERRUPTED)
            if cause is None and out_of_memory(error):
                first = str(error).strip().partition("\n")[0]
                stop(f"error: too little memory: {first}; lower {SMALLER}", BAD_INPUT)
            if not (cause or isinstance(error, OSError) or of_hydra(error) or place_of(error)):
                raise
            stop(f"error: {cause or line_of(error) or type(error).__name__}", BAD_INPUT)

    return guarded


def stop(text: str, code: int) -> NoReturn:
    """Print a line on stderr and exit."""
    with suppress(OSError), unbroken_output():
        print(f"lcc_rl: {one_line(text)}", file=sys.stderr)
    sys.exit(code)
