"""Who is compared in an evaluation: named policies and controllers, baselines, and the variant."""

from __future__ import annotations

import json
import logging
import re
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lcc_rl.config.compose import NOT_IDENTITY
from lcc_rl.config.nodes import Node, as_plain, nodes_in
from lcc_rl.config.schemas import AUTO, EvaluateConfig, StudyConfig
from lcc_rl.config.unused import FIXED, drawn_in_training, of_package, refuse
from lcc_rl.config.words import FILTERED, RECORDED, typed_keys
from lcc_rl.envs import Inputs, build_env
from lcc_rl.errors import ConfigError, require
from lcc_rl.evaluation.fit import (
    check_policy,
    check_variant,
    conditions_of,
    of_observation,
    other_traffic,
    task_of,
)
from lcc_rl.evaluation.foreign import GivenPolicy, check_observed
from lcc_rl.evaluation.named import DIRECT, PEOPLE, controller_of, is_policy, label_of
from lcc_rl.evaluation.strategies import (
    Strategy,
    TrainedPolicy,
    applies,
    baselines,
    beside_filtered,
    front_of,
    studied,
    trained,
    with_safety,
)
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.results.names import in_words
from lcc_rl.results.policies import load_policy, of_task
from lcc_rl.results.runs import POLICY, flatten, without
from lcc_rl.results.sweeps import labels
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
        only_named = bool(cfg.compare) and cfg.policy is None and cfg.learns
        self.own = own and not only_named
        if self.own and cfg.automated:
            check_variant(cfg)
        self.rivals, self.paths = self._compared()
        self._check_used(typed)
        self.policy, self.policies = self._read_policies()
        self._warn_of_kept(typed)
        read = [self.policy] if self.policy else self.policies
        agents = sorted({training.agent.name for _, training in read})
        unread = self.policy or not (self.own or self.further)
        if unread and cfg.learns and cfg.agent.name not in agents:
            reason = f"the policy has the agent of its training, {' or '.join(agents)}"
            refuse(typed, {"agent": reason if agents else "no row is a policy"})
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
        trainings = [x for _, x in filter(None, [self.policy, *self.policies])]
        safety = [x.scenario.filters.get(AUTOMATED) for x in (cfg, *trainings)]
        if not any(safety) or not (trainings or self.further):
            hint = "" if any(safety) else " (+filter=cbf adds one)"
            idle = f"no trained policy drives behind the safety filter{hint}"
            refuse(typed, {"evaluation.behind_filter": idle})

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
        unused |= drawn_in_training(cfg.scenario)
        nodes = [controller_of(spec) for spec in specs if spec not in (DIRECT, PEOPLE)]
        others = self.paths or self.further or {DIRECT, PEOPLE} & {*map(str, specs)}
        if not others and cfg.is_fixed(nodes):
            unused |= dict.fromkeys(("seed", "evaluation.seed", "drivers"), FIXED)
        if self.own and cfg.learns and cfg.policy is not None:
            unused |= FROM_TRAINING
        # Also for a rule with the policy of a sweep's other runs.
        observing = self.further or cfg.policy is not None or (self.own and cfg.learns)
        learned = self.paths or observing
        if cfg.evaluation.rows == "episodes" and not (cfg.evaluation.terms and learned):
            why = "only rows of policies have it, with evaluation.terms=true"
            unused |= dict.fromkeys(("reward.terms.", "reward.without"), why)
            if cfg.evaluation.terms:
                unused["evaluation.terms"] = "no row is a policy"
        # A user's controller or piece may read what is observed.
        if not observing and of_package([cfg.scenario, cfg.observation, *nodes]):
            unused["observation"] = "no row observes; a policy observes as in its training"
        # A removed piece may need its terms removed.
        removed = any(word.startswith("~scenario.") for word in typed)
        refuse((word for word in typed if not (removed and word.startswith("~"))), unused)
        if self.own or self.further or cfg.variant in rows or not cfg.automated:
            return
        check_effective(typed, self.rivals or rows, [*rows, *rivals], bool(self.paths))

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

    def _warn_of_kept(self, typed: Sequence[str]) -> None:
        """Warn of typed settings of what a compared policy observes, if it keeps others."""
        for (_, path), (_, training) in zip(self.paths, self.policies, strict=True):
            for name in sorted(of_observation(training)):
                own, given = training.scenario.pieces[name], self.cfg.scenario.pieces.get(name)
                asked = given.settings if given else {}
                other = {x for x, mine in own.settings.items() if mine != asked.get(x)}
                keys = tuple(f"scenario.pieces.{name}.{x}." for x in other - {*conditions_of(own)})
                kept = [x for x in typed if any(f"{y}.".startswith(keys) for y in typed_keys(x))]
                words = ", ".join(x.lstrip("+") for x in kept)
                if kept:
                    log.warning("%s observes as in its training, without %s", path, words)

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
        rows = with_safety(named_apart(beside_filtered(cfg, rows) + rows), cfg.safety)
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
        check_observed(policy, env)
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
    unused = FROM_TRAINING | {AUTO: "every controller is named and has its own settings"}
    if not learned and not any(str(x).endswith(FILTERED) for x in specs):
        reason = f"nothing drives behind the filter ({', '.join(rows)}); "
        reason += f"it needs a name that ends in {FILTERED}"
        unused |= dict.fromkeys(("filter", "scenario.filters", "safety"), reason)
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


# -- names in tables that tell policies of different trainings apart -------------------------------

# Settings that do not distinguish trainings: those of other commands, and those of the seed.
OF_NO_TRAINING = (*NOT_IDENTITY, "seed", "evaluation", "policy", "inputs.policy")
DATED = re.compile(r"^\d{4}-\d\d-\d\d_(\d\d-\d\d-\d\d)-\d{6}_.*")


def named_apart(strategies: Sequence[Strategy]) -> list[Strategy]:
    """Return strategies with names that differ if their trainings differ by more than the seed.

    If a variant was learned by several kinds of agents, the agent is added to the name. If settings
    differ otherwise, or a seed occurs twice, the file or folder of the policy is added. Several
    seeds of one training share a name, that of their folder. If one folder holds several trainings,
    the settings that differ are added.
    """
    kinds = [s.cfg.agent.name if s.policy else "" for s in strategies]
    by_agent = _where_several(strategies, kinds, kinds)
    marks = _trainings(by_agent)
    return _where_several(by_agent, marks, _labels(by_agent, marks))


def _where_several(
    strategies: Sequence[Strategy], marks: Sequence[Hashable], labels: Sequence[str]
) -> list[Strategy]:
    different = Counter(
        name for name, _ in {(s.name, m) for s, m in zip(strategies, marks, strict=True)}
    )
    return [
        replace(one, name=f"{one.name} {label}") if different[one.name] > 1 else one
        for one, label in zip(strategies, labels, strict=True)
    ]


def _trainings(strategies: Sequence[Strategy]) -> list[tuple[str, int]]:
    """Return settings, and number among equal seeds, by which policies of a name differ."""
    marks: list[tuple[str, int]] = []
    of_seed: Counter[Hashable] = Counter()
    for s in strategies:
        settings = dict(flatten(as_plain(s.own or s.cfg))) if s.policy else {}
        text = json.dumps(without(settings, OF_NO_TRAINING), sort_keys=True, default=str)
        of_seed[s.name, text, s.seed] += 1
        marks.append((text, of_seed[s.name, text, s.seed] if s.policy else 0))
    return marks


def _labels(strategies: Sequence[Strategy], marks: Sequence[tuple[str, int]]) -> list[str]:
    """Return the addition to the name of each policy, the same for the seeds of a training."""
    groups = [(s.name, mark) for s, mark in zip(strategies, marks, strict=True)]
    titles: dict[tuple[str, tuple[str, int]], str] = {}
    for s, group in zip(strategies, groups, strict=True):
        titles.setdefault(group, _place(s, groups.count(group) > 1))
    apart = Counter((name, title) for (name, _), title in titles.items())
    differences: dict[tuple[str, str], str] = {}
    for name in {name for name, _ in groups}:
        texts = {
            text: Path(s.source)
            for s, (other, (text, _)) in zip(strategies, groups, strict=True)
            if other == name
        }
        every = labels([json.loads(text) for text in texts], list(texts.values()))
        for text, changes in zip(texts, every, strict=True):
            differences[name, text] = ", ".join(changes.values())
    additions = []
    for s, (name, (text, which)) in zip(strategies, groups, strict=True):
        title = titles[name, (text, which)]
        if apart[name, title] > 1:  # one folder holds several trainings, or one twice
            twice = (name, (text, 2)) in titles or not differences[name, text]
            title = _place(s, False) if twice else differences[name, text]
        additions.append(title)
    return additions


def _place(strategy: Strategy, of_sweep: bool) -> str:
    """Return the name of a policy's file or run, or of the folder of its runs."""
    path = Path(strategy.source).absolute()  # a relative path has a folder, too
    path = path.parent if path.name == POLICY else path
    name = path.parent.name if of_sweep else path.name.removesuffix(".pt")
    return DATED.sub(r"\1", name)  # of a run's folder, the time of day


def check_distinct(strategies: Sequence[Strategy]) -> None:
    """Refuse two policies of one name and seed.

    Raises:
        ConfigError: naming the variant and the seed.
    """
    counts = Counter((strategy.name, strategy.seed) for strategy in strategies)
    for name, seed in (key for key, count in counts.items() if count > 1):
        which = name if seed is None else f"{name} with training seed {seed}"
        raise ConfigError(
            f"policy and compare name two policies called {which}: give them different "
            "names, 'compare={first: …, second: …}'"
        )
