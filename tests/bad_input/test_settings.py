"""Bad settings: each one ends in one line that names it, before any data are read."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter

import pytest
from commands import NO_AGENT

from lcc_rl.commands import calibration, training
from lcc_rl.config import load
from lcc_rl.errors import ConfigError

HUGE = 10**15
AUTO = "scenario.controllers.automated"
# What is typed after the variant, and the words of the error.
WRONG = {
    # unknown names
    "sead=3": "unknown option 'sead'.*Did you mean 'seed'",
    "+sead=3": "unknown option 'sead'.*Did you mean 'seed'",
    "agnet=ddpg": "unknown option 'agnet'.*Did you mean 'agent'",
    "agent=dddpg": "unknown choice of agent 'dddpg'.*Did you mean 'ddpg'",
    "experiment=smok": "unknown choice of experiment 'smok'.*Did you mean 'smoke'",
    "hydra/launcher=cluster": "unknown choice of hydra/launcher 'cluster'",
    "reward.terms.safety.wieght=1": "setting of reward.terms.safety .*'weight'",
    "reward.terms.safty.weight=1": "unknown name 'safty'",
    "reward.termz.safety.weight=1": "setting of reward .*'termz'",
    "training.epsodes=3": "setting of training .*'episodes'",
    "agent.gama=0.9": "setting of agent .*'gamma'",
    "data.sede=3": "setting of data .*'seed'",
    # types
    "seed=abc": "seed must be a valid integer",
    "training.episodes=2.5": "training.episodes must be a valid integer",
    "evaluation.baselines=idm": "evaluation.baselines must be a valid list",
    "agent=5": "agent=5",
    "scenario.pieces.ttc=5": "ttc: expected a node",
    "data.path=a (copy).csv": "cannot be read as a setting.*quotes within quotes",
    "scenario.initial_speed=${nowhere}": "nowhere",
    "~drivers": "drivers is required",
    "~scenario.controllers.automated": "scenario.controllers names only human",
    "agent=null": "agent=null",
    "logger=[nan,1]": "logger=",
    "+scenario.controllers.human.time_gap=${scenario}": "Interpolation to parent node",
    # ranges
    "scenario.time_step=nan": "scenario.time_step must be a finite number",
    "scenario.time_step=20": "scenario.time_step must be less than or equal to 10",
    f"scenario.horizon={HUGE}": "scenario.horizon must be less than",
    "training.gap_range=[inf,1]": r"gap_range.0 must be a finite number",
    "seed=-1": "seed must be greater than or equal to 0",
    f"seed={10**19}": "seed must be a number of 63 bits",
    "threads=100000": "threads must be less than",
    "training.environments=0": "training.environments must be greater",
    "evaluation.batch_size=0": "evaluation.batch_size must be greater",
    "reward.terms.safety.weight=-1": "reward.terms.safety.weight must be greater",
    "agent.gamma=1.5": "gamma",
    "agent.hidden=[-1]": "hidden",
    "agent.batch_size=50000": "buffer_size",
    "training.episodes=25": "training.episodes",
    "figure_formats=[pdf]": "figure_formats must name png",
    # objects of another kind
    "data._target_=os.getcwd": "data.*",
    f"{AUTO}._target_=fractions.Fraction": "automated.*Fraction",
    "reward.terms.safety._target_=nowhere.X": "cannot find 'nowhere.X'",
    "observation._target_=os.sep": "'os.sep' is no class or function",
    "reward.terms.hdv_energy=null": "~reward.terms.hdv_energy",
    "device=meta": "device must match pattern .*cpu.cuda.*got 'meta'",
    "device=cuda:77": "device 'cuda:77' is not available",
    # what does not fit together
    "scenario.string='automated bus'": "role 'bus', but .* only automated, human",
    "scenario.string='automated (human*2'": "never closed at character 11",
    "scenario.string={size: 10, penetration: 0}": "nobody is automated",
    "agent=none": "alcc is a learned controller",
    # sizes that no machine has
    f"training.environments={HUGE} training.episodes={HUGE}": "training.environments=",
    f"agent.buffer_size={HUGE}": "agent.buffer_size=.* needs about .* PiB",
    "scenario.string='automated human*100000000'": "10000 vehicles",
}
# Options without effect on the variant, and why.
IGNORED = {
    "variant=cacc split.by=vehicle": "leader=trajectories",
    "variant=cacc drivers=kde": "there is no human driver",
    "scenario=ring agent=none split.by=vehicle": "a ring road has no leader",
    "scenario.circumference=200": "belongs to scenario.road=ring",
    "variant=idm training.episodes=20": "variant idm learns nothing",
    f"variant=direct {AUTO}.max_acceleration=2": "no vehicle of the string is automated",
    "evaluation.full_length=true": "unused with evaluation.rows=episodes",
    "experiment=limits agent.tau=0.3": "bootstrap=false learns no value",
}


def train_without_data(words: list[str], folder: Path) -> None:
    cfg = load("train", [*NO_AGENT, "variant=alcc", *words])
    if not any(word.startswith("data.") for word in words):
        cfg.data = {"_target_": "lcc_rl.data.sources.EpisodesSource", "path": "nowhere.parquet"}
    training.run(cfg, folder, quiet=True)


@pytest.mark.parametrize("typed", WRONG)
def test_a_bad_setting_is_one_line_before_the_data_are_read(tmp_path, typed) -> None:
    words = [typed] if "'" in typed or "{" in typed or "(" in typed else typed.split()
    begun = perf_counter()
    with pytest.raises(ConfigError, match=WRONG[typed]) as caught:
        train_without_data(words, tmp_path)
    assert "\n" not in str(caught.value)
    assert perf_counter() - begun < 10


@pytest.mark.parametrize("typed", IGNORED)
def test_options_without_effect_are_refused(typed) -> None:
    with pytest.raises(ConfigError, match=rf"has no effect: .*({IGNORED[typed]})"):
        load("train", typed.split())


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        ("bounds.time_gap=[2,1]", "time_gap"),
        ("local_genetic.generations=0", "generations"),
        ("modes=[loacl]", "mode"),
        ("model=idn", "idn"),
        ("_target_=os.getcwd", "calibration"),
    ],
)
def test_a_bad_setting_of_a_calibration_is_named(tmp_path, typed, words) -> None:
    with pytest.raises(ConfigError, match=words):
        calibration.run(load("calibrate", [f"calibration.{typed}"]), tmp_path)


@pytest.mark.parametrize("variant", ["idm", "direct", "cacc"])
def test_a_learner_is_no_variant_that_learns_nothing(tmp_path, variant) -> None:
    with pytest.raises(ConfigError, match=f"variant={variant} learns nothing: remove agent="):
        training.run(load("train", [f"variant={variant}", "agent=ddpg"]), tmp_path)
