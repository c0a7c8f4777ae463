"""Running a command of the package inside the test process."""

from __future__ import annotations

import contextlib
import importlib
import io
import logging
import os
import sys
from unittest import mock

from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig


def run_command(module: str, *overrides: str) -> tuple[int, str, str]:
    """Run ``python -m module overrides…`` without a new process.

    The working directory is the present one (``monkeypatch.chdir``). Environment, logging and
    Hydra's state are restored afterwards; signal handlers are restored by the command itself.

    Args:
        module: name of a module with a ``main``, such as ``lcc_rl.train``.
        overrides: arguments of the command line.

    Returns:
        Exit status, standard output and standard error.
    """
    main = importlib.import_module(module).main
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    out, err, status = io.StringIO(), io.StringIO(), 0
    hydra_config = HydraConfig.instance().cfg
    with (
        mock.patch.object(sys, "argv", [module, *overrides]),
        mock.patch.dict(os.environ),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        GlobalHydra.instance().clear()
        try:
            main()
        except SystemExit as stop:
            status = int(stop.code or 0)
        finally:
            GlobalHydra.instance().clear()
            HydraConfig.instance().cfg = hydra_config
            for handler in set(root.handlers) - set(handlers):
                handler.close()
            root.handlers[:] = handlers
            root.setLevel(level)
    return status, out.getvalue(), err.getvalue()
