"""Command-line room: what every Hydra entry point does around its own work."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, NoReturn

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from lcc_rl.config import explained, is_sweep
from lcc_rl.config_checks import check_ignored
from lcc_rl.config_errors import check_keys
from lcc_rl.errors import ConfigError, Interrupted, LccError
from lcc_rl.runs.interrupts import INTERRUPTED, interruptible
from lcc_rl.runs.precision import set_precision
from lcc_rl.runs.states import Busy, forget, input_error, is_finished, record
from lcc_rl.runs.sweeps import SweepCallback, conclude, run_job

# OSError: Hydra cannot make the run's folder, a disk is full, a file is not ours to read.
INPUT_ERRORS = (LccError, HydraException, OmegaConfBaseException, OSError)
TRACEBACK = "HYDRA_FULL_ERROR"
BAD_INPUT = 2
NO_BEST = "No trials are completed"  # says Optuna


def entry_point(config_name: str) -> Callable[[Callable[[DictConfig], Any]], Callable[[], None]]:
    """Make a function of a configuration a command: Hydra around it, clear errors around Hydra.

    Whatever is wrong with the input (an option, a file, a row) ends in one line on stderr and
    exit code 2, and in ``error.txt`` of the run's folder; Ctrl-C in exit code 130. A bug still
    shows its traceback. In a sweep a failed run does not stop the others; all are named at the end.
    ``HYDRA_FULL_ERROR=1`` shows tracebacks of input errors, too.

    Args:
        config_name: the entry point's configuration in ``lcc_rl.conf``, without suffix.
    """

    def decorate(function: Callable[[DictConfig], Any]) -> Callable[[], None]:
        @wraps(function)
        def job(config: DictConfig) -> Any:
            def checked(config: DictConfig) -> Any:
                check_keys(config)
                check_ignored(config, HydraConfig.get().overrides.task, is_sweep())
                return function(config)

            if is_sweep():
                return run_job(checked, config, run_folder())
            return main_guard(recorded(checked))(config)

        command = hydra.main(
            version_base="1.3", config_path="pkg://lcc_rl.conf", config_name=config_name
        )(job)

        @wraps(function)
        def main() -> None:
            wanted = TRACEBACK in os.environ
            # Makes Hydra hand errors over instead of printing them in its own way.
            os.environ.setdefault(TRACEBACK, "1")
            guarded = sweep if wanted else main_guard(explaining(sweep, config_name))
            try:
                with interruptible():
                    guarded(command)
            finally:
                if not wanted:
                    os.environ.pop(TRACEBACK, None)

        return main

    return decorate


def sweep(command: Callable[[], Any]) -> None:
    """Run a Hydra command; where it was a sweep, say how its runs ended."""
    try:
        command()
    except KeyboardInterrupt:
        folder = SweepCallback.end()
        if folder is None:
            raise
        raise Interrupted(f"stopped; the same command goes on in {folder}") from None
    except ValueError as error:
        # Hydra's plugin wants the best trial also where every one failed: conclude names those.
        if NO_BEST not in str(error):
            raise
    finally:
        folder = SweepCallback.end()
    if folder is not None:
        conclude(folder)


def explaining(function: Callable[..., Any], entry: str) -> Callable[..., Any]:
    """Say what Hydra says about a wrong option again, with the nearest option that exists."""

    def explained_function(*arguments: Any) -> Any:
        try:
            return function(*arguments)
        except HydraException as error:
            overrides = [item for item in sys.argv[1:] if not item.startswith("-")]
            clearer = explained(error, entry, overrides)
            if clearer is error:
                raise
            raise clearer from error

    return explained_function


def recorded(function: Callable[[DictConfig], Any]) -> Callable[[DictConfig], Any]:
    """Leave ``error.txt`` in the run's folder where it fails; a finished run stays finished."""

    def recording(cfg: DictConfig) -> Any:
        folder = run_folder()
        forget(folder)
        try:
            return function(cfg)
        except (Interrupted, Busy):
            raise
        except Exception as error:
            # A command that names a finished run by mistake is no failure of that run.
            if not is_finished(folder):
                record(folder, error)
            raise

    return recording


def main_guard(function: Callable[..., Any]) -> Callable[..., Any]:
    """Turn errors of the input into one line on stderr and exit code 2."""

    @wraps(function)
    def guarded(*arguments: Any, **settings: Any) -> Any:
        try:
            return function(*arguments, **settings)
        except INPUT_ERRORS as error:
            _stop(error)
        except KeyboardInterrupt:
            print("lcc_rl: interrupted", file=sys.stderr)
            sys.exit(INTERRUPTED)

    return guarded


def _stop(error: Exception) -> NoReturn:
    """Print an error in one line; Hydra wraps those of a constructor, which says more."""
    cause = input_error(error)
    text = " ".join(str(cause or error).split())
    if isinstance(cause, Interrupted):
        print(f"lcc_rl: {text}", file=sys.stderr)
        sys.exit(INTERRUPTED)
    print(f"lcc_rl: error: {text}", file=sys.stderr)
    sys.exit(BAD_INPUT)


def run_folder() -> Path:
    """The folder of the present run, made by Hydra (the run's or the sweep job's)."""
    return Path(HydraConfig.get().runtime.output_dir)


def prepare_torch(cfg: DictConfig) -> torch.device:
    """Check ``seed``, ``threads`` and ``device`` of a study, set up torch, return the device.

    Raises:
        ConfigError: if one of them is of the wrong type or impossible on this machine.
    """
    for name, least in (("seed", 0), ("threads", 1)):
        value = cfg.get(name)
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise ConfigError(f"{name} must be a whole number from {least} up, got {value!r}")
    try:
        device = torch.device(cfg.device)
        torch.empty(0, device=device)
    # Which error torch raises depends on how it was built.
    except (RuntimeError, AssertionError, TypeError) as error:
        raise ConfigError(f"device {cfg.device!r} is not available: {error}") from error
    torch.set_num_threads(cfg.threads)
    set_precision(cfg.get("matmul_precision", "highest"))
    # TorchRL tells of every buffer it allocates.
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    return device
