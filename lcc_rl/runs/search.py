"""Resumption of a stopped Optuna search."""

from __future__ import annotations

import logging
import warnings
from collections import defaultdict
from typing import Any

from omegaconf import DictConfig, read_write

log = logging.getLogger("lcc_rl")


def resume_search(config: DictConfig, alone: bool) -> None:
    """Reduce ``n_trials`` of an Optuna sweeper by the completed trials of its stored study.

    Without this, Hydra's plugin adds ``n_trials`` at every start. Failed trials are replaced;
    interrupted ones are queued first, so that their runs resume in their folders.

    Args:
        config: Hydra's configuration of the sweep, changed in place.
        alone: whether no other process works on this sweep.
    """
    sweeper = config.hydra.sweeper
    if "OptunaSweeper" not in str(sweeper.get("_target_")) or sweeper.storage is None:
        return
    import optuna

    try:
        study = optuna.load_study(study_name=sweeper.study_name, storage=sweeper.storage)
    except KeyError:  # not started
        return
    by_state: dict[str, list[Any]] = defaultdict(list)
    for trial in study.get_trials(deepcopy=False):
        by_state[trial.state.name].append(trial)
    done = len(by_state["COMPLETE"])
    wanted = int(sweeper.n_trials)
    with read_write(config):
        sweeper.n_trials = max(0, wanted - done)
    if not sweeper.n_trials:
        words = "search finished before: %d of %d trials, in %s; for more, raise %s"
        log.info(words, done, wanted, config.hydra.sweep.dir, "hydra.sweeper.n_trials")
        return
    log.info("search resumed: %d of %d trials done before", done, wanted)
    if alone:
        _repeat(study, by_state)


def _repeat(study: Any, by_state: dict[str, list[Any]]) -> None:
    """Queue the interrupted trials that are neither finished nor queued."""
    known = [trial.params for trial in by_state["COMPLETE"] + by_state["FAIL"]]
    known += [trial.system_attrs.get("fixed_params") for trial in by_state["WAITING"]]
    for trial in by_state["RUNNING"]:
        if trial.params and trial.params not in known:
            with warnings.catch_warnings():  # that it is experimental
                warnings.simplefilter("ignore")
                study.enqueue_trial(trial.params)
            known.append(trial.params)
