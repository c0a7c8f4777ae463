"""Search room: an Optuna search that was stopped goes on where it stood."""

from __future__ import annotations

import logging
import warnings
from typing import Any

from omegaconf import DictConfig, read_write

log = logging.getLogger("lcc_rl")


def go_on(config: DictConfig, alone: bool) -> None:
    """Leave to an Optuna sweeper only the trials that its stored study still lacks.

    Hydra's plugin would add ``n_trials`` further ones whenever it is called. Trials that failed are
    replaced; those that were cut off are tried first, so that their runs go on in their folders.

    Args:
        config: Hydra's configuration of the sweep; ``n_trials`` is lowered in place.
        alone: whether no other process works on this sweep.
    """
    sweeper = config.hydra.sweeper
    if "OptunaSweeper" not in str(sweeper.get("_target_")) or sweeper.storage is None:
        return
    import optuna

    try:
        study = optuna.load_study(study_name=sweeper.study_name, storage=sweeper.storage)
    except KeyError:  # not begun
        return
    by_state: dict[str, list[Any]] = {}
    for trial in study.get_trials(deepcopy=False):
        by_state.setdefault(trial.state.name, []).append(trial)
    done = len(by_state.get("COMPLETE", []))
    wanted, folder = int(sweeper.n_trials), config.hydra.sweep.dir
    with read_write(config):
        sweeper.n_trials = max(0, wanted - done)
    if not sweeper.n_trials:
        words = "search finished before: %d of %d trials, in %s; for more, raise %s"
        log.info(words, done, wanted, folder, "hydra.sweeper.n_trials")
        return
    log.info("search goes on: %d of %d trials done before", done, wanted)
    if alone:
        _repeat(study, by_state)


def _repeat(study: Any, by_state: dict[str, list[Any]]) -> None:
    """Queue the trials that nobody finished and nobody queued since."""
    known = [trial.params for kind in ("COMPLETE", "FAIL") for trial in by_state.get(kind, [])]
    known += [trial.system_attrs.get("fixed_params") for trial in by_state.get("WAITING", [])]
    for trial in by_state.get("RUNNING", []):
        if trial.params and trial.params not in known:
            with warnings.catch_warnings():  # that it is experimental
                warnings.simplefilter("ignore")
                study.enqueue_trial(trial.params)
            known.append(trial.params)
