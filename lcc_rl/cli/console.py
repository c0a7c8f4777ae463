"""The console command ``lcc-rl`` with all commands of the package."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module

from lcc_rl.cli.guard import main_guard
from lcc_rl.errors import unknown_name
from lcc_rl.runs.interrupts import ending_quietly
from lcc_rl.version import __version__

# Names and descriptions of the functions of lcc_rl.cli.hydra_commands.
HYDRA_COMMANDS = {
    "run": "the main job: data, drivers, policies, results, one page",
    "train": "train a variant and evaluate it; -m for a sweep",
    "evaluate": "compare policies, controllers and baselines",
    "calibrate": "fit driver models to trajectories",
}
TOOLS = {  # name, module, which has a main, and description
    "status": ("lcc_rl.runs.overview", "runs that are running, waiting, finished, failed"),
    "table": ("lcc_rl.cli.table", "the table of an evaluation: text, Markdown, LaTeX, CSV"),
    "repeat": ("lcc_rl.commands.repeat", "a run again, from its folder; are the rows equal?"),
    "score": ("lcc_rl.cli.score", "a policy on every task and source that it fits"),
    "simulate": ("lcc_rl.commands.simulate", "vehicles behind a leader or on a ring: their motion"),
    "energy": ("lcc_rl.cli.energy", "energy of recorded trips: kJ, kWh, litres, grams"),
    "animate": ("lcc_rl.commands.animate", "animations of episodes: page, SVG, GIF, MP4"),
    "reproduce": ("lcc_rl.studies.reproduce", "a paper's study: tables and figures"),
    "clairvoyant": ("lcc_rl.commands.clairvoyant", "upper bound of the saving"),
    "export": ("lcc_rl.cli.export", "a policy or rule as ONNX, PyTorch, C or page"),
}
COMMANDS = HYDRA_COMMANDS | {name: text for name, (_, text) in TOOLS.items()}


@main_guard
def main(words: Sequence[str] | None = None) -> None:
    """Run ``lcc-rl <command> …`` and exit with its code.

    Args:
        words: the words after ``lcc-rl``; by default this process's arguments.
    """
    words = list(sys.argv[1:] if words is None else words)
    if not words or words[0] in ("-h", "--help"):
        print(_help())
    elif words[0] == "--version":
        print(f"lcc-rl {__version__}")
    elif words[0] not in COMMANDS:
        raise unknown_name("command", words[0], COMMANDS)
    else:
        _run(words[0], words[1:])


def _help() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {text}" for name, text in COMMANDS.items()]
    return "\n".join(
        [
            f"lcc-rl {__version__}: learn and compare car-following controllers in mixed traffic",
            "",
            "usage: lcc-rl <command> …      lcc-rl <command> -h      lcc-rl --version",
            "",
            *lines,
            "",
            "run, train, evaluate and calibrate take settings as key=value (seed=3).",
        ]
    )


def _run(name: str, words: list[str]) -> None:
    """Run a command with the following words as this process's arguments."""
    sys.argv = [f"lcc-rl {name}", *words]
    hydra = name in HYDRA_COMMANDS
    with ending_quietly():
        module = import_module("lcc_rl.cli.hydra_commands" if hydra else TOOLS[name][0])
    if hydra:
        getattr(module, name)()
    else:
        sys.exit(module.main(words))
