"""Bad settings: each one ends in one line that names it, before any data are read."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from types import SimpleNamespace

import pytest
from commands import NO_AGENT, tiny
from helpers import check_refused

import lcc_rl
from lcc_rl.agents.controller import ControllerPolicy
from lcc_rl.commands import calibration, evaluation, training
from lcc_rl.commands.pipeline import composed_part
from lcc_rl.config import load
from lcc_rl.config.unused import check_used
from lcc_rl.data.leaders import Mixture
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.entrants import Entrants
from lcc_rl.functional.ovm import OVMConstants
from lcc_rl.io import memory
from lcc_rl.pieces.connected import CACC
from lcc_rl.pieces.controllers import ConstantAcceleration

HUGE = 10**15
AUTO = "scenario.controllers.automated"
# What is typed after the variant, and the words of the error.
WRONG = {
    # unknown names
    "sead=3": "'sead'.*'seed'",
    "time_step=1": "it is scenario.time_step",
    "help": "key=value; -h shows the help",
    "scenario.controllers.human.parameters={a: 1}": "drivers=fixed drivers.acceleration",
    "variant=[alcc,reference]": "variant takes one choice; for a run of each: -m variant=alcc,refe",
    "energy=[fuel,bolt]": "energy takes one choice",
    "+scenario.filters.automated.margin=1": "'automated'.*valid: none; .filter=cbf or a task adds",
    "+scenario.actuators.automated.lag=0.4": "'automated'.* .faults=all actuators and sensors",
    "agent.regularizers.nosuch.weight=1": "'nosuch', which has no _target_; valid: none; <name>={",
    "scenario.pieces.traffic.delay=1": r"; \+knowledge=traffic adds it, knowledge=\[…,traffic\] b",
    "scenario.pieces.fuel.x=1": "'fuel', which has no _target_; valid: [^;]*$",
    "agent.surrogates.nosuch.weight=1": "'nosuch', which has no _target_; valid:",
    "+scenario.fleet.t={_target_: builtins.dict}": "scenario.fleet.t: expected a .*VehicleClass",
    "scenario.string='automated human*٢٥'": "expected .* at character 16",
    "agent=dddpg": "agent 'dddpg'.*'ddpg'.* agent/dddpg.yaml, needs --config-dir",
    "reward.terms.safety.wieght=1": "reward.terms.safety .*'weight'",
    "learning=follow": "choice of learning 'follow'; valid: follow_samples.*, needs --config-dir",
    "agent._partial_=true": "agent._partial_ has no effect",
    "~agent": "~agent: other choices depend on it; write agent=null$",
    "experiment=limits agent=ddpg": r"gamma must .*; it follows from .*experiment=limits agent=dd",
    "agent=analytic reward.terms.efficiency.threshold=0.1": "0.1; it follows from .*threshold=0",
    "agent.gamma=???": r"^agent\.gamma=\?\?\?: expected a value",
    "variant=cacc gains.k5=1": r"setting of gains 'k5'.*; valid: k1, k2, k3, k4",
    f"variant=hcfs {AUTO}.jerk_weight=1": r"It is deployed\.jerk_weight",
    # types
    "seed=abc": "seed must be .* integer",
    "scenario.pieces.ttc=5": "ttc: expected a node",
    "leader.path=a.csv": r"got \{'path': 'a.csv'\}; choose one, too: leader=drives\|",
    "data.path=a (copy).csv": r"data\.path=a \(copy\)\.csv.*quotes",
    "+scenario.controllers.human.time_gap=${scenario}": "parent node",
    "+scenario.controllers.human.time_gap=${reward.no}": "takes its value from 'reward.no'",
    "~drivers": "drivers is required",
    f"~{AUTO}": "names only human",
    # ranges
    "scenario.time_step=nan": "scenario.time_step must be .*finite",
    "scenario.time_step=1": "scenario.time_step must be .* 0.5",
    "agent.actor_lr=1e6": "agent.actor_lr must be less than or equal to 1",
    f"scenario.horizon={HUGE}": "scenario.horizon must be less than",
    f"seed={10**19}": "seed must be a number of 63 bits",
    "agent.batch_size=50000": "buffer_size",
    "agent=analytic +agent.limits.spacing=30": r"agent\.limits\.spacing must be less than 1, got",
    "evaluation.baselines=[human,human]": "baselines names human 2 times",
    "agent=analytic evaluation.warm_up=0.5 training.segment=4": r"divide 15, .*\(20\) less 5 steps",
    "agent.limits.efficiency=0.2": "no agent.surrogates.efficiency; surrogates@agent=limits adds",
    "reward.without=[safety,jerk]": "term of the reward in reward.without 'jerk'; valid",
    "+logger={_target_: lcc_rl.runs.loggers.RowLogger, kind: paper}": "kind must be",
    # objects of another kind
    "data._target_=os.getcwd": "data.*",
    "reward.terms.safety._target_=nowhere.X": "cannot find 'nowhere.X'",
    "data._target_=lcc_rl.data.sources.EpisodeSource": "Did you mean 'EpisodesSource'",
    # what does not fit together
    "scenario.string='automated bus'": "role 'bus', but .* only automated, human",
    "scenario.string='automated (human*2'": "never closed at character 11",
    "variant=hcfs task=i80-follow": "hcfs is of connected vehicles.* task=platoon-us06",
    "~scenario.pieces.ttc": "'ttc'.*, which the evaluation measures",
    "~scenario.pieces.predicted_power": r"reads human\.predicted_power, which no piece",
    # sizes that no machine has
    f"training.environments={HUGE} training.episodes={HUGE}": "training.environments=.* needs",
    f"agent.buffer_size={HUGE}": "agent.buffer_size=.* needs about .* PiB",
    "agent.hidden=[1000000000000] agent.batch_size=1": "agent.hidden=.* needs about .* TiB",
    "agent.hidden=[300000,300000]": "agent.hidden=.* needs about .* TiB",
    "scenario.string='automated human*100000000'": "10000 vehicles",
    "+faults=sensors scenario.sensors.automated.delay=1e9": "sensors.automated.delay must be at mo",
    "+faults=sensors scenario.sensors.automated.longest_dropout=200": "dropout must be at most 100",
    "drivers.reaction_delay=0.25 drivers=i80_energy": "delay of drivers must be a multiple",
    f"data.platoons={HUGE}": "data.platoons must be less than or equal to 10000",
}
# Options without effect on the variant, and why.
IGNORED = {
    "variant=cacc split.by=vehicle": "leader=trajectories",
    f"controller@{AUTO}=handover agent=td3": "handover drives the .* uses no action",
    "scenario.circumference=200": "belongs to scenario.road=ring",
    "scenario=ring scenario.start.human.cap_time_gap=2": "of a ring start evenly spaced",
    "task=platoon-us06 training.gap_range=[1,1]": "no start of the scenario refers to it",
    "+knowledge=[memory,traffic]": "no vehicle but the leader, whose speed traffic repeats",
    "scenario=ring training.gap_range=[1,1]": "of a ring start evenly spaced",
    "variant=idm training.episodes=20": "variant idm has no agent",
    "variant=alcc scenario.string=human*3 training.episodes=20": "no vehicle .* is automated",
    f"variant=direct {AUTO}.max_acceleration=2": "no vehicle of the string is automated",
    "evaluation.baselines=[human]": "a training evaluates its own policy",
    "variant=alcc agent=ppo agent.gamma=0.9": "agent.horizon=30 sets it",
    "evaluation.behind_filter=[]": "a training evaluates its own policy",
    "evaluation.front=[1.2]": "a training evaluates its own policy",
    "evaluation.full_length=true": "belong to evaluation.rows=vehicles",
    "variant=hcfs evaluation.repeats=5": "drives behind every record once",
    "variant=hcfs drivers=highway": "no vehicle of this platoon depends on drivers",
    "variant=cacc scenario.vehicle_length=12": "evaluation.rows=vehicles has no flow",
    "variant=direct +filter=cbf": "no vehicle of the string is automated",
    "variant=direct +event=lost_target": "no vehicle of the string is automated",
    "variant=direct +faults=sensors": "no vehicle of the string is automated",
    "variant=alcc deployed.choice=first": "belongs to variant=hcfs",
    "+filter=cbf scenario.filters.automated.robust=false": "actuators and sensors are exact",
    "sweep=mine": "names the folder of a sweep, -m",
    "variant=own_energy observation.visible=2": "scales names no vehicle behind",
    "reward.without=safety reward.terms.safety.threshold=3": "reward.without leaves the term out",
    "reward.without=[safety] reward.terms.safety.weight=3": "reward.without leaves the term out",
}
# Settings of an evaluation of a policy without effect, by variant, and why.
OF_TRAINING = "has the (settings|agent) of its training"
EVALUATED = {
    "alcc training.segment=20": OF_TRAINING,
    "alcc training.gap_range=[0.2,0.3]": "only episodes of a training draw it",
    "alcc agent.hold=5": OF_TRAINING,
    "alcc scenario.controllers.human.time_gap_range=[1,2]": "only episodes of a training draw it",
    "alcc agent=ppo": f"{OF_TRAINING}, analytic",
    "alcc reward.terms.safety.weight=5": "only rows of policies have it, with evaluation.terms",
    "alcc reward.without=safety": "only rows of policies have it, with evaluation.terms",
    "alcc ~reward.terms.safety": "only rows of policies have it, with evaluation.terms",
    "alcc evaluation.behind_filter=[acc_filtered]": "no trained policy drives behind",
    "idm": "variant idm has no agent",
    "hcfs +energy@evaluation.second_energy=compact": "drives behind every record once",
    "hcfs evaluation.sample_episodes=0": "drives behind every record once",
    "hcfs evaluation.seed=99": "no vehicle of this platoon depends on drivers or noise",
    "hcfs drivers=highway": "no vehicle of this platoon depends on drivers or noise",
}
# Settings of terms and surrogates that a training by the gradient ignores, and why.
GRADIENT = {
    "agent.bootstrap=false reward.terms.collision.weight=9": "CollisionPenalty has no gradient",
    "experiment=limits reward.terms.collision.behind=false": "CollisionPenalty has no gradient",
    "agent.policy=idm agent.bootstrap=false agent.hidden=[8]": "agent.policy=idm without a value",
    "agent.policy=acc experiment=limits agent.activation=elu": "agent.policy=acc without a value",
    "reward.terms.safety.floor=0.1": r"surrogates.safety \(SmoothSafety\) takes the term's place",
    "reward.terms.hdv_energy.power=vehicles.power": "surrogates.hdv_energy .* takes the term's",
    "reward.terms.safety={_target_:lcc_rl.pieces.JerkReward}": "takes the term's place",
    "agent.limit_rate=0.3": "agent.limits has no limit",
    "experiment=limits agent.limit_damping=1": "agent.limits has no limit of an average",
    "~reward.terms.safety agent.surrogates.safety.weight=2": "the reward has no term safety",
    "reward.terms.safety.weight=0 agent.surrogates.safety.weight=2": "has no term safety",
    "agent.surrogates.safety.threshold=5 agent.surrogates.safety.limit=3": "belongs to agent.lim",
    "experiment=limits reward.terms.efficiency.weight=5": "agent.limits.efficiency sets the price",
    "experiment=limits reward.terms.safety.weight=5": "agent.surrogates.safety.weight is 0",
    "experiment=limits agent.surrogates.safety.width=1": "agent.surrogates.safety.weight is 0",
    "experiment=limits agent.tau=0.1": "agent.bootstrap=false learns no value",
    "experiment=main reward.terms.efficiency.threshold=2": r"\(ExcessSpacing\) takes the term",
    "experiment=main agent.limits.safety=0.1 ~reward.terms.safety": "reward has no term safety",
}


def train_without_data(words: list[str], folder: Path) -> None:
    cfg = load("train", [*NO_AGENT, "variant=alcc", *words])
    if not any(word.startswith("data.") for word in words):
        other = load("train", ["data=episodes", "data.path=nowhere.parquet"])
        cfg = cfg.with_(data=other.data)
    training.run(cfg, folder, quiet=True)


def evaluated(variant: str, *words: str) -> None:
    typed = [f"variant={variant}", "policy=pretrained", "experiment=smoke", *words]
    Entrants(load("evaluate", typed), typed=typed)


def test_a_bad_setting_is_one_line_before_the_data_are_read(tmp_path) -> None:
    begun = perf_counter()
    check_refused(
        lambda typed: train_without_data(
            [typed] if set("'{(") & set(typed) else typed.split(), tmp_path / "run"
        ),
        WRONG.items(),
        ConfigError,
    )
    assert perf_counter() - begun < 10 * len(WRONG)
    assert not list(tmp_path.glob("run/*.parquet"))


def test_options_without_effect_are_refused() -> None:
    cases = [(typed, rf"has no effect: .*({why})") for typed, why in IGNORED.items()]
    ignored = {f"variant=alcc agent=analytic {typed}": why for typed, why in GRADIENT.items()}
    cases += [(typed, rf"has no effect: .*({why})") for typed, why in ignored.items()]
    check_refused(lambda typed: load("train", typed.split()), cases, ConfigError)
    cases = [(typed, rf"has no effect: .*({why})") for typed, why in EVALUATED.items()]
    check_refused(lambda typed: evaluated(*typed.split()), cases, ConfigError)
    load("train", ["agent=analytic", "reward.terms.collision.weight=9", "agent.policy=idm"])
    evaluated("alcc", "agent=analytic", "seed=7", "evaluation.seed=${seed}")  # have an effect
    evaluated("alcc", "evaluation.terms=true", "reward.terms.safety.weight=5")
    evaluated("alcc", "+filter=cbf", "evaluation.behind_filter=[acc_filtered]")
    evaluated("hcfs", "compare=[idm]", "drivers=highway", "evaluation.seed=99")
    stronger = f"+{AUTO}.max_acceleration=6"
    words = [stronger, "compare=[idm_acc]"]
    named = "has no effect: every controller is named"
    cases = [(lambda: Entrants(load("evaluate", words), typed=words), named)]
    cases += [(lambda: lcc_rl.compare("idm_acc", overrides=words[:1]), named)]
    own = [f"{AUTO}.time_gap=1.5"]
    cases += [(lambda: lcc_rl.simulate([9.0] * 9, "automated", "acc", overrides=own), named)]
    idle = r"\+filter=cbf has no effect: nothing drives behind the filter \(acc\); .* _filtered"
    cases += [(lambda: lcc_rl.compare("acc", overrides="+filter=cbf"), idle)]
    idle = {"agent.gamma=0.5": "of its training", "seed=3": "evaluation.seed"}
    idle |= {"observation.visible=3": "no row observes", "agent=ppo": "no row is a policy"}
    idle |= {"evaluation.terms=true": "no row", "reward.terms.safety.weight=0": "of policies"}
    for typed, why in idle.items():
        cases += [(lambda x=typed: lcc_rl.compare("acc", overrides=[x]), f"{typed} has.*{why}")]
    shipped = "pretrained/alcc"
    cases += [(lambda: lcc_rl.compare(shipped, overrides=["agent=ppo"]), "training, analytic$")]
    check_refused(lambda call: call(), cases, ConfigError)
    both = ["evaluation.terms=true", "policy=pretrained", "observation.raw=true"]
    shared = load("evaluate", ["variant=idm", both[0]]).with_(policy="pretrained")
    check_used(shared, both, sweep=True)  # of runs with and without an agent
    Entrants(shared, typed=both)
    assert load("evaluate", [f"{AUTO}.time_gap=1.5", words[1], "variant=idm"]).compare
    words = ["variants=[alcc]", "evaluation.baselines=[human]"]  # a job compares
    trainings, final = composed_part(load("pipeline", words), words)
    assert final.evaluation.baselines == ["human"] != trainings["alcc"].evaluation.baselines
    case = (["agent=none"], "variant=reference is a learned controller, but there is no agent")
    check_refused(lambda words: composed_part(load("pipeline", words), words), [case], ConfigError)


class Own(CACC):
    """May draw what its base does not."""


def test_a_platoon_with_a_class_of_ones_own_may_depend_on_drivers() -> None:
    own = f"{AUTO}._target_={__name__}.Own"
    fixed = [load("evaluate", ["variant=cacc", *words]).is_fixed() for words in ([], [own])]
    assert fixed == [True, False]


def test_programs_are_refused_what_has_no_effect_in_them() -> None:
    cases = [
        (lcc_rl.learn, "alcc", ["hydra.run.dir=a"], r"hydra.run.dir=a has no effect .* folder="),
        (lcc_rl.compare, [], "alcc", "expected strategies, or a mapping of them by name: \\[\\]"),
        (lcc_rl.compare, {3: "idm"}, "alcc", "mapping of them by name: {3: 'idm'}"),
    ]
    check_refused(lambda call, *given: call(*given), cases, ConfigError)


def test_drivers_have_an_effect_on_whatever_drives_as_they_do() -> None:
    for controller in ("calibrated", "ovm", "fvdm", "gipps", "human", "handover"):
        words = ("variant=idm", "scenario.string=automated", f"controller@{AUTO}={controller}")
        highway = load("train", [*words, "drivers=highway"]).drivers
        assert highway != load("train", words).drivers, controller


def test_a_bad_setting_of_a_calibration_is_named(tmp_path) -> None:
    check_refused(
        lambda typed: calibration.run(load("calibrate", [typed]), tmp_path),
        [("calibration.modes=[loacl]", "mode"), ("calibration._target_=os.getcwd", "calibration")],
        ConfigError,
    )


def test_what_must_be_positive_is_refused_at_every_door() -> None:
    doors = (
        lambda number: OVMConstants(form=number),
        lambda number: ControllerPolicy(ConstantAcceleration().bind(), number),
        lambda number: Mixture({"a": number}, a=SimpleNamespace(load=list)),
    )
    numbers = (0.0, -1.0, float("nan"), float("inf"), True, "1")
    cases = [(door, x, "must be a positive, finite number") for door in doors for x in numbers]
    check_refused(lambda door, number: door(number), cases, ConfigError)


def test_an_evaluation_that_does_not_fit_is_refused_once_the_data_are_read(
    tmp_path, monkeypatch
) -> None:
    many = ("evaluation.drivers=null", "evaluation.repeats=8")
    cfg = tiny("evaluate", "variant=idm", *many, agent=False)
    monkeypatch.setattr(memory, "available", lambda device: 6 * 2**20)
    with pytest.raises(ConfigError, match="an evaluation of 3984 episodes of 20 steps side by"):
        evaluation.run(cfg, tmp_path)
