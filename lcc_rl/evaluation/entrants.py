"""Who is compared in an evaluation: named policies and controllers, baselines, and the variant."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lcc_rl.config.nodes import Node, nodes_in
from lcc_rl.config.schemas import AUTO, EvaluateConfig, StudyConfig
from lcc_rl.config.unused import refuse
from lcc_rl.config.words import FILTERED, RECORDED
from lcc_rl.envs import Inputs, build_env
from lcc_rl.errors import ConfigError, require
from lcc_rl.evaluation.fit import check_policy, check_variant, other_traffic, task_of
from lcc_rl.evaluation.foreign import GivenPolicy
from lcc_rl.evaluation.named import DIRECT, PEOPLE, controller_of, is_policy, label_of
from lcc_rl.evaluation.naming import check_distinct, named_apart
from lcc_rl.evaluation.strategies import (
    Strategy,
    TrainedPolicy,
    applies,
    baselines,
    beside_filtered,
    front_of,
    studied,
    trained,
)
from lcc_rl.functional.pattern import AUTOMATED, HUMAN
from lcc_rl.results.names import in_words
from lcc_rl.results.policies import PRETRAINED, load_policy, of_task
from lcc_rl.results.runs import POLICY
from lcc_rl.runs.states import CONFIG, run_folders

log = logging.getLogger("lcc_rl")

FROM_TRAINING = dict.fromkeys(("agent.", "training."), "a policy has the settings of its training")


class Entrants:
    """The strategies of an evaluation.

    Names are checked and policies are read here, before the data, which may take minutes.

    Args:
        cfg: configuration of the entry point ``evaluate``.
        own: include the configuration's variant, unless ``compare`` names every policy.
        further: further policies by their names in tables.
        typed: overrides; those of a controller or filter that no row has are refused.

    Raises:
        LccError: if two share a name, a name is reserved, or a controller or policy is unknown,
            does not fit or has no vehicle to drive.
    """

    def __init__(
        self,
        cfg: EvaluateConfig,
        own: bool = True,
        further: Mapping[str, GivenPolicy] | None = None,
        typed: Sequence[str] = (),
    ) -> None:
        self.cfg, self.further, self.task = cfg, further or {}, task_of(cfg)
        if cfg.policy not in (None, PRETRAINED) and not cfg.learns and cfg.automated:
            raise ConfigError(f"variant {cfg.variant} has no agent: remove policy={cfg.policy}")
        only_named = bool(cfg.compare) and cfg.policy is None and cfg.learns
        self.own = own and not only_named
        if self.own and cfg.automated:
            check_variant(cfg)
        self.rivals, self.paths = self._compared()
        self._check_used(typed)
        self.policy, self.policies = self._read_policies()
        learned = self.policy and self.policy[1].agent.name
        if learned and learned != cfg.agent.name:
            refuse(typed, {"agent": f"the policy has the agent of its training, {learned}"})
        check_installed(cfg, list(self.rivals.values()))
        recorded = RECORDED in {*self.rivals, *cfg.evaluation.baselines}
        for asked in [] if recorded else self._limits_of_record():
            raise ConfigError(f"{asked}: add {RECORDED} to evaluation.baselines")
        if self.own and cfg.learns and cfg.policy is None:
            raise ConfigError(
                f"variant {cfg.variant} is learned: give policy=<run folder or policy.pt> "
                f"(of lcc-rl train variant={cfg.variant}) or policy=pretrained, or compare others "
                "only: compare=[human]"
            )

    def _compared(self) -> tuple[dict[str, Any], list[tuple[str, str]]]:
        """Return the controllers of ``compare`` by name, and its policies with name, if given."""
        cfg, named = self.cfg, _by_label(self.cfg.compare)
        by_name = isinstance(cfg.compare, Mapping)
        policies = [
            (label if by_name else "", self._of_task(run))
            for label, spec in named.items()
            if is_policy(spec)
            for run in _runs_of(Path(spec))
        ]
        rivals = {label: spec for label, spec in named.items() if not is_policy(spec)}
        for label, spec in rivals.items():
            _check_label(label, spec, str(spec).removesuffix(FILTERED))
            if spec != DIRECT:
                controller_of(spec)
        if not cfg.automated:
            if ignored := [*named, *filter(None, [cfg.policy])]:
                log.warning("no vehicle is automated; left out: %s", ", ".join(ignored))
            return {}, []
        for label in rivals:
            message = f"compare={label}: it has no vehicle to drive in this string"
            require(applies(cfg, label), message)
        return rivals, policies

    def _check_used(self, typed: Sequence[str]) -> None:
        cfg, rivals, named = self.cfg, [*self.rivals.values()], self.cfg.evaluation.baselines
        rows, specs = [*self.rivals, *named], [*rivals, *named]
        unused = {"seed": "it is that of trainings; evaluation.seed draws other noise"}
        if self._is_fixed(specs):
            reason = "no vehicle of this platoon depends on drivers or noise"
            unused |= dict.fromkeys(("seed", "evaluation.seed", "drivers"), reason)
        if self.own and cfg.learns and cfg.policy is not None:
            unused |= FROM_TRAINING
        learned = self.paths or self.further or cfg.policy is not None
        if cfg.evaluation.rows == "episodes" and not (cfg.evaluation.terms and learned):
            unused["reward.terms."] = "only rows of policies have it, with evaluation.terms=true"
        refuse((word for word in typed if not word.startswith("~")), unused)
        if self.own or self.further or cfg.variant in rows or not cfg.automated:
            return
        check_effective(typed, self.rivals or rows, [*rows, *rivals], bool(self.paths))

    def _is_fixed(self, specs: Sequence[Any]) -> bool:
        """Return whether all rows are of a platoon in which no piece reads drivers or noise."""
        scenario, others = self.cfg.scenario, self.paths or self.further or DIRECT in specs
        platoon = self.cfg.evaluation.rows == "vehicles"
        if others or not platoon or {*scenario.vehicles.names} != {AUTOMATED}:
            return False
        own = scenario.with_(controllers={HUMAN: None}, start={HUMAN: None})
        nodes = nodes_in([own, self.cfg.deployed, *map(controller_of, specs)])
        return all(vars(node.kind).get("steady", False) for node in nodes)

    def _of_task(self, path: str) -> str:
        return of_task(path, None if self.task is None else self.task.name)

    def _read_policies(self) -> tuple[TrainedPolicy | None, list[TrainedPolicy]]:
        """Read the policy under study, if there is one, and compared policies."""
        cfg, policy = self.cfg, None

        def read(path: str) -> TrainedPolicy:
            weights, training = load_policy(path, cfg.variant, tuple(cfg.trust))
            if warning := other_traffic(path, training, cfg):
                log.warning(warning)
            return weights, training

        if cfg.policy is not None and cfg.learns:
            policy = read(self._of_task(str(cfg.policy)))
            check_policy(cfg, policy[1])
        policies = [read(path) for _, path in self.paths]
        for (name, path), (_, training) in zip(self.paths, policies, strict=True):
            _check_label(name, path, training.variant)
        return policy, policies

    def strategies(self, inputs: Inputs) -> list[Strategy]:
        """Build the strategies in the order of their rows: baselines and rules, then policies.

        Raises:
            LccError: if a policy or controller does not fit the inputs.
        """
        cfg, rows = self.cfg, self._rules(inputs)
        for (name, path), file in zip(self.paths, self.policies, strict=True):
            learned = trained(cfg, path, file, inputs.population)
            rows.append(replace(learned, name=name or learned.name))
        if self.own:
            rows += studied(cfg, self.policy, inputs.population)
        rows += [self._given(name, policy, inputs) for name, policy in self.further.items()]
        rows = named_apart(beside_filtered(cfg, rows) + rows)
        check_distinct(rows)
        rows += front_of(rows, cfg.evaluation.front)
        for strategy in (s for s in rows if s.source):
            log.info("%s: the policy of %s", in_words(strategy.name), strategy.source)
        return rows

    def _given(self, name: str, policy: GivenPolicy, inputs: Inputs) -> Strategy:
        """Return the strategy of a policy of another library, after a trial."""
        cfg = self.cfg
        _check_label(name, "a policy", "")
        require(cfg.learns, f"{name} is a policy, and variant {cfg.variant} has no agent")
        env = build_env(cfg, inputs.evaluation, inputs.population, 1, 0, cfg.device, nominal=True)
        policy.tried(env.reset())
        return Strategy(name, cfg, policy)

    def _rules(self, inputs: Inputs) -> list[Strategy]:
        """Return the baselines and named controllers; ``recorded`` only with recorded drivers."""
        lacking = ""
        if inputs.evaluation.followers is None:
            lacking = "no driver was recorded behind these leaders"
        elif not applies(self.cfg, RECORDED):
            lacking = "the automated vehicle is not the first behind the leader"
        named = [f"compare={RECORDED}"] * (RECORDED in self.rivals)
        for asked in named + self._limits_of_record():
            require(not lacking, f"{asked}: {lacking}; use trajectories of several vehicles")
        if lacking and RECORDED in self.cfg.evaluation.baselines:
            log.warning("%s is left out: %s", RECORDED, lacking)
        every = baselines(self.cfg, self.rivals)
        return [s for s in every if not lacking or s.name != RECORDED]

    def _limits_of_record(self) -> list[str]:
        """Return the limits of the task that refer to the recorded drivers."""
        limits = self.task.limits if self.task else {}
        return [f"task.limits.{key}={RECORDED}" for key, x in limits.items() if x == RECORDED]


def check_effective(
    typed: Sequence[str], rows: Iterable[str], specs: Iterable[Any], learned: bool = False
) -> None:
    """Refuse overrides of a training, a controller or a safety filter that no row has.

    Args:
        typed: the overrides.
        rows: names of the rows in tables.
        specs: names of all controllers.
        learned: whether a row is a policy.
    """
    unused = {AUTO: "every controller is named and has its own settings"}
    unused |= FROM_TRAINING
    if not learned and not any(str(x).endswith(FILTERED) for x in specs):
        reason = f"nothing drives behind the filter ({', '.join(rows)}); "
        reason += f"it needs a name that ends in {FILTERED}"
        unused |= dict.fromkeys(("filter", "scenario.filters"), reason)
    refuse(typed, unused)


def _by_label(named: Sequence[Any] | Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what ``compare`` names by the names in tables."""
    for spec in named.values() if isinstance(named, Mapping) else named:
        require(
            isinstance(spec, (str, Node)),
            f"compare names {spec!r}: expected a name, a path or a node; for several runs, the "
            "folder that holds them",
        )
    if isinstance(named, Mapping):
        return named
    labels = [spec if is_policy(spec) else label_of(spec) for spec in named]
    for label, count in Counter(labels).items():
        message = f"compare names two {label}: give each a name, 'compare={{first: …, second: …}}'"
        require(count == 1, message)
    return dict(zip(labels, named, strict=True))


def _check_label(label: str, spec: Any, own: str) -> None:
    """Refuse reserved names of rows; ``own`` is allowed for the strategy of that name."""
    plain = label.removesuffix(FILTERED)
    require(
        in_words(plain) in (plain, in_words(own)),
        f"compare names {label_of(spec)} {label}, which stands for {in_words(label)!r}: choose "
        "another",
    )


def _runs_of(path: Path) -> list[str]:
    """Return the runs with a policy in the folder of a sweep; else the path."""
    sweep = path.is_dir() and not (path / CONFIG).exists()
    runs = [run for run in run_folders(path) if (run / POLICY).is_file()] if sweep else []
    return list(map(str, runs or [path]))


def check_installed(cfg: StudyConfig, compared: Sequence[Any] = ()) -> None:
    """Refuse controllers that need a missing package, before data are read.

    Args:
        cfg: configuration of a study, including its baselines.
        compared: further controllers, see :func:`lcc_rl.evaluation.named.controller_of`.
    """
    names = [name for name in cfg.evaluation.baselines if applies(cfg, name)]
    further = [controller_of(spec) for spec in (*names, *compared) if spec not in (DIRECT, PEOPLE)]
    for node in nodes_in([cfg.scenario.controllers, *further]):
        getattr(node.kind, "check_installed", lambda: None)()
