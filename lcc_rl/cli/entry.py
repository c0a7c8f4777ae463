"""Hydra entry points with one-line errors and exit codes."""

from __future__ import annotations

import logging
import os
import re
import sys
import traceback
from argparse import ArgumentParser
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from functools import wraps
from importlib import import_module
from pathlib import Path
from textwrap import wrap
from typing import Any
from unittest.mock import patch

import hydra
from hydra import compose, initialize_config_module
from hydra._internal.hydra import Hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from lcc_rl.cli.console import HYDRA_COMMANDS
from lcc_rl.cli.guard import main_guard
from lcc_rl.config.compose import (
    CONF,
    HYDRA_ERRORS,
    as_meant,
    check_own_files,
    choices,
    conf_folder,
    explained,
    is_sweep,
    parsed,
)
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.config.words import check_once, top_key
from lcc_rl.errors import ConfigError, Interrupted, LccError, ResultsError, input_error, require
from lcc_rl.runs.interrupts import ending_quietly, was_interrupted
from lcc_rl.runs.states import CONFIG, Busy, forget, record, withdraw
from lcc_rl.runs.sweeps import SweepCallback, conclude, run_job

HELP, FULL_HELP = {"-h", "--help"}, "--help-all"
ENTRY_COMMANDS = {"pipeline": "run"}  # commands with another name than their configuration
EXAMPLES = {
    "pipeline": (
        ("lcc-rl run", "on data in the package: minutes"),
        ("lcc-rl run data=ngsim data.path=tracks.csv", "on your trajectories"),
        ("lcc-rl run experiment=smoke", "a check in seconds"),
    ),
    "train": (
        ("lcc-rl train variant=alcc experiment=limits", "a minute"),
        ("lcc-rl train task=ring-22 scenario.horizon=2000", "a task with limits"),
        ("lcc-rl train -m variant=alcc,reference 'seed=range(8)'", "a sweep; it resumes"),
    ),
    "evaluate": (
        ("lcc-rl evaluate policy=outputs/train/<run>", "baselines"),
        ("lcc-rl evaluate 'compare=[my_pieces.PID,mpc,pretrained/alcc]'", "controllers"),
        ("lcc-rl evaluate task=ring-22 'compare=[pretrained,pid.yaml]'", "a task"),
    ),
    "calibrate": (
        ("lcc-rl calibrate", "on a stream"),
        ("lcc-rl calibrate data=ngsim data.path=tracks.csv", "on yours"),
        ("lcc-rl train drivers=calibrated drivers.path=drivers.parquet", "then"),
    ),
}
TRAFFIC = ("data", "data.path", "drivers", "scenario.string", "scenario.horizon")
OPTIONS = {
    "pipeline": (
        *("experiment", "agent", *TRAFFIC[:2], "calibration", "variants", "scenario.string"),
        *("evaluation.drivers", "seed", "jobs", "figure_formats", "resume"),
    ),
    "train": (
        *("variant", "task", "experiment", "agent", *TRAFFIC),
        *("training.episodes", "seed", "resume"),
    ),
    "evaluate": (
        *("variant", "task", "policy", "compare", "filter", *TRAFFIC),
        *("evaluation.drivers", "table"),
    ),
    "calibrate": ("calibration", *TRAFFIC[:2], "seed", "threads", "figure_formats"),
}
TOTAL_WIDTH, NAME_WIDTH, DEFAULT_WIDTH = 80, 21, 16


def help_text(entry: str, overrides: Sequence[str]) -> str:
    """Return the help of a command.

    Args:
        entry: ``"train"``, ``"evaluate"``, ``"calibrate"`` or ``"pipeline"``.
        overrides: overrides of the command line, which change the displayed defaults.
    """
    name = ENTRY_COMMANDS.get(entry, entry)
    typed = [word for word in overrides if word[:1] != "-" and "=" in word]
    with initialize_config_module(CONF, version_base="1.3"):
        cfg = compose(entry, overrides=as_meant(typed), return_hydra_config=True)
    wide = max(len(command) for command, _ in EXAMPLES[entry])
    lines = [f"lcc-rl {name}: {HYDRA_COMMANDS[name]}", ""]
    lines += [f"  {command:<{wide}}  # {what}" for command, what in EXAMPLES[entry]]
    lines += ["", f"{'option=…':<{NAME_WIDTH}}{'default':<{DEFAULT_WIDTH}}choices or meaning"]
    for key in OPTIONS[entry]:
        lines += _option(entry, key, cfg)
    return "\n".join(
        [
            *lines,
            "",
            f"Settings of conf/: lcc-rl {name} --cfg job. Defaults of all classes:",
            "python tools/settings.py writes docs/settings.md in a clone. Groups: --help-all.",
            "-m runs a sweep of all combinations: a=1,2 b=3,4.",
        ]
    )


def _option(entry: str, key: str, cfg: Any) -> Iterator[str]:
    """Yield the lines of an option: name, default, and choices or meaning."""
    chosen = cfg.hydra.runtime.choices
    if names := choices(key):
        value, what = chosen.get(key) or "–", ", ".join(names)
        key = key if key in chosen else f"+{key}"
    else:
        found = OmegaConf.select(cfg, key)
        value = "–" if found is None else str(found)
        what = meaning(entry, key)
    first, *rest = wrap(what, TOTAL_WIDTH - NAME_WIDTH - DEFAULT_WIDTH) or [""]
    yield f"{key:<{NAME_WIDTH - 1}} {value:<{DEFAULT_WIDTH - 1}} {first}".rstrip()
    yield from (" " * (NAME_WIDTH + DEFAULT_WIDTH) + line for line in rest)


def meaning(entry: str, key: str) -> str:
    """Return the comment of a setting in the first file of conf/ with one."""
    folder, (root, _, last) = conf_folder(), key.rpartition(".")
    places = [folder / f"{name}.yaml" for name in (entry, "study", "base")]
    if root:
        places = sorted((folder / root).glob("*.yaml"))
    line = re.compile(rf"^\s*(?:# )?{re.escape(last)}: [^#\n]*#\s*(.*)$", re.MULTILINE)
    found = (line.search(place.read_text(encoding="utf-8")) for place in places)
    return next((match.group(1) for match in found if match), "")


TRACEBACK = "HYDRA_FULL_ERROR"
SWEEP = {"-m", "--multirun"}


def entry_point(
    config_name: str, work: str
) -> Callable[[Callable[[Any], Any]], Callable[[], None]]:
    """Decorate a function of a configuration as a Hydra command.

    An input error (option, file, row) gives one line on stderr, exit code 2 and ``error.txt`` in
    the run's folder. Ctrl-C gives exit code 130; other errors show a traceback. In a sweep a failed
    run does not stop the others. ``HYDRA_FULL_ERROR=1`` shows tracebacks of input errors, too.

    Args:
        config_name: the entry point's configuration in ``lcc_rl.conf``, without suffix.
        work: the module of the work, which loads torch. It is imported after the options are
            accepted (in a sweep before Hydra reads them), so ``--help`` and refused options need
            no torch. The function imports from it inside its body.
    """

    def decorate(function: Callable[[Any], Any]) -> Callable[[], None]:
        def checked(config: DictConfig) -> Any:
            logging.raiseExceptions = False  # a failing log must not end a run
            check_own_files()
            typed = list(HydraConfig.get().overrides.task)
            if config.get("resume") is not None:  # its settings may have names of its own
                own = ("resume", "trust", *["logger"] * (config_name == "train"))
                others = [x.removeprefix("++") for x in typed if top_key(x) not in own]
                message = "a resumed run keeps the settings it was started with; remove"
                require(not others, f"{message} {' '.join(others)}")
            with ending_quietly():  # settings load modules, too
                cfg = parsed(config, config_name, typed, is_sweep())
                import_module(work)
            return function(cfg)

        @wraps(function)
        def job(config: DictConfig) -> Any:
            if is_sweep():
                return run_job(checked, config, run_folder())
            return main_guard(explaining(recording_errors(checked)))(config)

        command = hydra.main(
            version_base="1.3", config_path="pkg://lcc_rl.conf", config_name=config_name
        )(job)

        @wraps(function)
        def main() -> None:
            if HELP.intersection(sys.argv):
                print(help_text(config_name, sys.argv[1:]))
                return
            if SWEEP.intersection(sys.argv):
                with ending_quietly():
                    import_module(work)
            start_command(command)

        return main

    return decorate


def start_command(command: Callable[[], Any]) -> None:
    """Run a Hydra command with this package's error messages and signal handlers."""
    wanted = TRACEBACK in os.environ
    # Hydra raises errors instead of printing them.
    os.environ.setdefault(TRACEBACK, "1")
    guarded = run_sorted if wanted else main_guard(explaining(run_sorted))
    try:
        guarded(command)
    finally:
        if not wanted:
            os.environ.pop(TRACEBACK, None)


def run_sorted(command: Callable[[], Any]) -> None:
    """Run a Hydra command with flags at any place among the settings."""
    words = ["--help" if word == FULL_HELP else word for word in sys.argv[1:]]
    mode = any("hydra.mode=" in word for word in words)  # else Hydra composes twice to look for it
    with (
        patch.object(sys, "argv", [sys.argv[0], *flags_first(words)]),
        patch.object(sys.modules["hydra.main"], "get_args_parser", hydra_parser),
        patch.object(Hydra, "get_mode", Hydra.get_mode if mode else lambda *_, **__: None),
    ):
        sweep(command)


def hydra_parser() -> ArgumentParser:
    """Return Hydra's parser, also with Python 3.14, which checks that each help is a text.

    Hydra 1.3 creates the help of ``--shell-completion`` only when it is shown.
    """
    with patch.object(ArgumentParser, "_check_help", lambda *_: None, create=True):
        return get_args_parser()


def flags_first(words: Sequence[str]) -> list[str]:
    """Return the words of a command line with flags, such as ``-m``, first."""
    parser = hydra_parser()
    parser.allow_abbrev = False  # --experiment is not a flag of Hydra
    known, unknown = parser.parse_known_intermixed_args(list(words))
    if unknown:
        raise ConfigError(
            f"unknown flag {unknown[0]}: settings are written key=value, without dashes; flags "
            "are --help, --cfg job, --info, --config-dir and, for a sweep, -m"
        )
    flags = list(words)
    for item in check_once(known.overrides):
        flags.remove(item)
    return [*flags, *as_meant(known.overrides)]


def sweep(command: Callable[[], Any]) -> None:
    """Run a Hydra command; report the result of a sweep."""
    try:
        command()
    except (KeyboardInterrupt, Exception) as error:
        folder = SweepCallback.end()
        if folder is not None and was_interrupted(error):
            raise Interrupted(f"stopped; the same command resumes it in {folder}") from None
        if folder is not None and isinstance(error, BrokenExecutor):
            words = "a process was killed; the same command resumes the sweep in"
            raise LccError(f"{words} {folder}") from None
        raise
    finally:
        folder = SweepCallback.end()
    if folder is not None:
        from lcc_rl.results.sweeps import without_effect  # loads pandas

        for line in without_effect(folder):
            logging.getLogger("lcc_rl").warning(line)
        conclude(folder, SweepCallback.plan)


def explaining(function: Callable[..., Any]) -> Callable[..., Any]:
    """Convert errors of Hydra to errors with the nearest option."""

    def explained_function(*arguments: Any) -> Any:
        try:
            return function(*arguments)
        except (*HYDRA_ERRORS, ValueError, TypeError) as error:
            *_, last = traceback.walk_tb(error.__traceback__)
            module = str(last[0].f_globals["__name__"])
            if not module.startswith(("hydra.", "omegaconf.")):
                raise
            typed = [word for word in sys.argv[1:] if "=" in word]
            raise input_error(error) or explained(error, typed) from error
        except OSError as error:
            if error.filename is not None or SweepCallback.target is None:
                raise
            # Raised for a file that Hydra writes.
            raise ResultsError(f"{SweepCallback.target}: {error}") from error

    return explained_function


def recording_errors(function: Callable[[DictConfig], Any]) -> Callable[[DictConfig], Any]:
    """Remove the folder of a refused command, and write ``error.txt`` for a failed one.

    The message of an interrupted command contains the command that resumes it. Folders of other
    runs are not changed.
    """

    def recording(cfg: DictConfig) -> Any:
        folder = run_folder()
        before = (folder / CONFIG).exists()
        try:
            result = function(cfg)
        except (Interrupted, Busy):
            raise
        except (KeyboardInterrupt, Exception) as error:
            if was_interrupted(error):
                if "resume" in cfg and (folder / CONFIG).exists():
                    name = HydraConfig.get().job.config_name
                    from lcc_rl.results.runs import read_settings
                    from lcc_rl.results.trust import trust_option

                    command = f"lcc-rl {'run' if name == 'pipeline' else name} resume={folder}"
                    command += trust_option(read_settings(folder / CONFIG))
                    raise Interrupted(f"stopped; resume with: {command}") from error
                raise
            given = isinstance(input_error(error) or error, (LccError, OSError))
            if given and not (folder / CONFIG).exists() and SweepCallback.made:
                withdraw(SweepCallback.made)
            elif not before:
                record(folder, error)
            raise
        forget(folder)
        return result

    return recording


def run_folder() -> Path:
    """Return the folder that Hydra created for the present run or job."""
    return Path(HydraConfig.get().runtime.output_dir)


def resumed_folder(cfg: StudyConfig) -> Path:
    """Return the folder of the run ``resume``, or of the present run, as an absolute path."""
    return run_folder() if cfg.resume is None else Path(os.path.abspath(cfg.resume))
