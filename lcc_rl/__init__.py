"""Learn and compare car-following controllers in mixed traffic.

``lcc_rl.simulate`` drives a string of vehicles behind a leader, ``lcc_rl.make_env`` builds a
TorchRL environment of one, ``lcc_rl.learn`` trains a policy, ``lcc_rl.compare`` evaluates several,
``lcc_rl.export`` writes one for other software, ``lcc_rl.trip_energies`` returns the energy of
recorded trips and ``lcc_rl.results`` reads the results of runs.
The command is ``lcc-rl``.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from lcc_rl.io.memory import uncollected
from lcc_rl.version import __version__

# Modules of names that load torch.
LAZY = {
    "make_env": "lcc_rl.envs.factory",
    "learn": "lcc_rl.api",
    "compare": "lcc_rl.api",
    "export": "lcc_rl.interfaces.export",
    "simulate": "lcc_rl.evaluation.simulation",
    "trip_energies": "lcc_rl.commands.energy",
}
__all__ = ["__version__", "results", *LAZY]


def __getattr__(name: str) -> Any:
    # Lazy, so that reading the version does not load torch.
    if name in LAZY:
        with uncollected():  # a sixth of the time
            return getattr(import_module(LAZY[name]), name)
    if name == "results":
        return import_module("lcc_rl.results")
    raise AttributeError(f"module 'lcc_rl' has no attribute {name!r}")
