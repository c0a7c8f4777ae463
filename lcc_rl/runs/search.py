"""A Hydra sweeper that searches settings by Optuna: ``hydra/sweeper=lcc_optuna``.

Hydra's own plugin needs Optuna 2 and SQLAlchemy 1, which are no longer kept.
"""

from __future__ import annotations

import logging
import sys
from collections import defaultdict
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from lcc_rl.config import as_meant, key_of
from lcc_rl.errors import ConfigError, ResultsError, how_to_install
from lcc_rl.io.atomic import atomic_path
from lcc_rl.runs.states import survey
from lcc_rl.settings import Count, Settings, parse

log = logging.getLogger("lcc_rl")

RESULT = "optimization_results.yaml"
PLACE = "hydra_plugins.lcc_rl"  # Hydra takes plugins from this namespace only


def register() -> None:
    """Make the sweeper known to Hydra, and this module by the name of its place."""
    if "hydra_plugins" not in sys.modules and find_spec("hydra_plugins") is None:
        sys.modules["hydra_plugins"] = ModuleType("hydra_plugins")  # no other plugin is installed
    sys.modules[PLACE] = sys.modules[__name__]
    Plugins.instance().register(SearchSweeper)


class SearchSettings(Settings):
    """Settings of a search, ``hydra.sweeper`` on the command line."""

    directions: list[Literal["minimize", "maximize"]]  # of each value that objective names
    storage: str  # address of Optuna's storage
    study_name: str  # in it
    n_trials: Count  # that are to be complete
    n_jobs: Count  # trials launched together
    seed: int  # of Optuna's sampler (TPE)
    # Setting: fixed value or sweep (interval, range, choice, lists) in Hydra's words; sweeps on the
    # command line add to it.
    params: dict[str, Any]


class SearchSweeper(Sweeper):
    """Searches settings until the wanted number of trials of a stored study is complete.

    The same command resumes it: trials that were cut off come first, failed ones are replaced. Each
    trial is a run in its own folder, and several are drawn before they are launched together. Its
    arguments are those of :class:`SearchSettings`.
    """

    __module__ = PLACE

    def __init__(self, **given: Any) -> None:
        plain: Any = OmegaConf.to_container(OmegaConf.create(given))
        self.given = parse(SearchSettings, plain, "hydra.sweeper")

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Take what Hydra hands to every sweeper."""
        self.hydra_context, self.config = hydra_context, config
        self.folder = Path(config.hydra.sweep.dir)
        self.parser = OverridesParser.create(config_loader=hydra_context.config_loader)
        self.launcher: Launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> None:
        """Launch what lacks of the trials, and write the best beside the runs."""
        optuna = load_optuna()
        own = [f"{key}={value}" for key, value in self.given.params.items()]
        parsed = self.parser.parse_overrides([*own, *arguments])
        # The last one counts; the command line adds signs to keys.
        settings = {key_of(item.get_key_element()): item for item in parsed}
        swept = {key: item for key, item in settings.items() if item.is_sweep_override()}
        space = {key: distribution(optuna, item) for key, item in swept.items()}
        fixed = [
            f"{key}={item.get_value_element_as_str()}"
            for key, item in settings.items()
            if key not in swept
        ]
        self.folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(self.config, self.folder / "multirun.yaml")
        study = self.study(optuna)
        left = self.given.n_trials - resumed(study, self.folder, self.given.n_trials)
        for first in range(0, left, self.given.n_jobs):
            trials = [self.ask(study, space) for _ in range(min(self.given.n_jobs, left - first))]
            drawn = ([f"{k}={v}" for k, v in trial.params.items()] for trial in trials)
            batch = [as_meant([*fixed, *words]) for words in drawn]
            self.validate_batch_is_legal(batch)
            done = self.launcher.launch(batch, initial_job_idx=trials[0].number)
            for trial, job in zip(trials, done, strict=True):
                self.tell(study, trial, job)
        write_best(study, self.folder / RESULT)

    def study(self, optuna: ModuleType) -> Any:
        """Return the stored study, or a new one."""
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        try:
            study = optuna.create_study(
                storage=self.given.storage,
                study_name=self.given.study_name,
                directions=self.given.directions,
                load_if_exists=True,
            )
        except RuntimeError as error:
            words = "was begun with an older version of Optuna"
            raise ResultsError(
                f"{self.given.storage} {words}; give the sweep a new name"
            ) from error
        if len(study.directions) != len(self.given.directions):
            words = f"holds a search with {len(study.directions)} objectives"
            raise ResultsError(f"{self.given.storage} {words}; give the sweep a new name")
        return study

    def ask(self, study: Any, space: dict[str, Any]) -> Any:
        """Draw the next trial by a sampler of its own seed: resuming equals not having stopped."""
        number = len(study.get_trials(deepcopy=False))
        seed = int(np.random.SeedSequence([self.given.seed, number]).generate_state(1)[0])
        study.sampler = load_optuna().samplers.TPESampler(seed=seed)
        return study.ask(space)

    def tell(self, study: Any, trial: Any, job: JobReturn) -> None:
        """Store the values of a run, or that it failed."""
        value = job.return_value if job.status == JobStatus.COMPLETED else None
        if value is None:
            study.tell(trial, state=load_optuna().trial.TrialState.FAIL)
            return
        values = list(value) if isinstance(value, (list, tuple)) else [value]
        if len(values) != len(self.given.directions):
            words = f"objective names {len(values)} columns"
            raise ConfigError(f"{words}, hydra.sweeper.directions {len(self.given.directions)}")
        study.tell(trial, values)


def load_optuna() -> ModuleType:
    """Import Optuna."""
    try:
        import optuna
    except ImportError as error:
        words = "hydra/sweeper=lcc_optuna needs Optuna"
        raise ConfigError(f"{words}: {how_to_install('sweeps')}") from error
    return optuna


def distribution(optuna: ModuleType, sweep: Override) -> Any:
    """Return Optuna's distribution of a sweep in Hydra's words.

    ``interval(a, b)`` is a real number, with ``tag(int, …)`` a whole one and with ``tag(log, …)``
    drawn on a logarithmic scale; a range or list is one of its values.
    """
    kinds = optuna.distributions
    if not sweep.is_interval_sweep():
        return kinds.CategoricalDistribution(list(sweep.sweep_string_iterator()))
    given: Any = sweep.value()
    logarithmic = "log" in given.tags
    if not given.start < given.end or (logarithmic and given.start <= 0):
        words = "expected two numbers, the smaller first" + ", both positive" * logarithmic
        where = f"hydra.sweeper.params.{sweep.get_key_element()}"
        raise ConfigError(f"{where}: {words}; found {given.start}, {given.end}")
    if "int" in given.tags:
        return kinds.IntDistribution(int(given.start), int(given.end), log=logarithmic)
    return kinds.FloatDistribution(float(given.start), float(given.end), log=logarithmic)


def resumed(study: Any, folder: Path, wanted: int) -> int:
    """Return the number of complete trials of a study, and say so where there are any.

    Where no other process works on the sweep, trials that were cut off are queued: their runs
    resume in their folders.
    """
    by_state: dict[str, list[Any]] = defaultdict(list)
    for trial in study.get_trials(deepcopy=False):
        by_state[trial.state.name].append(trial)
    done = len(by_state["COMPLETE"])
    if done >= wanted:
        words = "search finished before: %d of %d trials, in %s; for more, raise %s"
        log.info(words, done, wanted, folder, "hydra.sweeper.n_trials")
    elif any(by_state.values()):
        log.info("search resumed: %d of %d trials done before", done, wanted)
        if not any(state.state == "running" for state in survey(folder)):
            _repeat(study, by_state)
    return done


def _repeat(study: Any, by_state: dict[str, list[Any]]) -> None:
    """Queue the interrupted trials that are neither finished nor queued."""
    known = [trial.params for trial in by_state["COMPLETE"] + by_state["FAIL"]]
    known += [trial.system_attrs.get("fixed_params") for trial in by_state["WAITING"]]
    for trial in by_state["RUNNING"]:
        if trial.params and trial.params not in known:
            study.enqueue_trial(trial.params)
            known.append(trial.params)


def write_best(study: Any, path: Path) -> None:
    """Write the best trial, or with several objectives all that no other one betters."""
    best = [
        {"number": trial.number, "values": list(trial.values), "params": dict(trial.params)}
        for trial in study.best_trials
    ]
    with atomic_path(path) as temporary:
        text = yaml.safe_dump({"name": "optuna", "best": best}, sort_keys=False)
        temporary.write_text(text, "utf-8")
