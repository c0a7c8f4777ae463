"""Help of the commands with settings; options are read from conf/."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from textwrap import wrap
from typing import Any

from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from lcc_rl.cli.console import HYDRA_COMMANDS
from lcc_rl.config.compose import CONF, as_meant, choices

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


def text(entry: str, overrides: Sequence[str] = ()) -> str:
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
            f"Settings of conf/: lcc-rl {name} --cfg job. Defaults of all classes: python",
            "tools/settings.py writes docs/settings.md. All groups: --help-all. Pages: docs/.",
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
    folder, (root, _, last) = Path(str(files(CONF))), key.rpartition(".")
    places = [folder / f"{name}.yaml" for name in (entry, "study", "base")]
    if root:
        places = sorted((folder / root).glob("*.yaml"))
    line = re.compile(rf"^\s*(?:# )?{re.escape(last)}: [^#\n]*#\s*(.*)$", re.MULTILINE)
    found = (line.search(place.read_text(encoding="utf-8")) for place in places)
    return next((match.group(1) for match in found if match), "")
