"""Connected vehicles by behaviour: dead-beat, jerk, causality, safety, any number of them."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import POPULATION, check_refused, composed, network, string, wavy_profiles
from platoons import (
    A_MAX,
    ACTORS,
    Actor,
    Driver,
    T,
    cacc,
    deadbeat,
    env_of,
    hcfs,
    leader,
    play,
    ramps,
    repeated,
    whole,
    wider,
    windows,
)
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from lcc_rl.config import load
from lcc_rl.data.profiles import Profiles
from lcc_rl.envs import Inputs, build_env
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.comparison import Comparison
from lcc_rl.evaluation.rollout import reset_options
from lcc_rl.evaluation.strategies import Strategy, baseline
from lcc_rl.functional.cacc import Gains
from lcc_rl.pieces import CACC, HCFS, Communication, parse_string
from lcc_rl.pieces.world import World

# -- dead-beat -------------------------------------------------------------------------------------


def test_oracle_dead_beat_has_no_error_where_limits_are_inactive() -> None:
    # In double precision: the claim is about the law, not about rounding.
    env = env_of(ramps(), deadbeat("oracle"))
    for piece in env.transform:
        piece.double()
    given = TensorDict({("leader", "profile"): torch.arange(3).unsqueeze(-1)}, [3])
    given.set(("leader", "start"), torch.zeros(3, 1, dtype=torch.int64))
    td = env.reset(options=given).apply(lambda x: x.double() if x.is_floating_point() else x)
    total = 0.0
    for _ in range(100):
        td = env.step(td)
        total += td["next", "vehicles", "leader_speed_error"].abs().sum()
        td = step_mdp(td)
    assert total < 1e-6


# -- CACC ------------------------------------------------------------------------------------------


def test_gains_behave_as_described() -> None:
    error = {}
    for name in ("path", "paper_like", "tuned"):
        series = play(ramps().select([0]), cacc(name), 8)
        error[name] = float(series["leader_speed_error"].abs().sum())
        jerk = float(series["jerk"].abs().sum())
        if name == "paper_like":
            # Near the CACC row of Table IV (149.6 and 735 on the paper-like ramp).
            assert error[name] > 100
            assert jerk > 400
    assert error["tuned"] < 0.25 * min(error["path"], error["paper_like"])


def test_cacc_closes_its_gaps() -> None:
    # From disturbed gaps behind a steady leader back to equilibrium: h plus what the delay hides.
    steady = leader(torch.full((401,), 10.0))
    exact = "scenario.pieces.leader.perturbation=0"
    cfg = composed("variant=cacc", "scenario.horizon=400", exact)
    env = build_env(cfg, steady, POPULATION, 4)
    td = env.reset()
    assert (td["vehicles", "gap"] - 5.0).abs().max() > 0.5
    with torch.no_grad():
        end = env.rollout(400, tensordict=td, auto_reset=False)[:, -1]["next", "vehicles"]
    torch.testing.assert_close(end["gap"], torch.full((4, 6, 1), 5.0), atol=0.06, rtol=0)
    assert end["leader_speed_error"].abs().max() < 1e-3


@pytest.mark.parametrize(
    ("gains", "literal", "gap"),
    # kx = 1.44 1/s at 5 m/s, messages 5 ms late: 5 + 0.025 m, literally 5/1.44 m less.
    [("tuned", False, 5.025), ("tuned", True, 1.553), ("path", False, 5.025)],
)
def test_the_printed_law_does_not_keep_the_gap(gains, literal, gap) -> None:
    setting = f"scenario.controllers.automated.literal={literal}"
    driver = Driver((*cacc(gains).overrides, setting))
    driven = play(leader(torch.full((401,), 5.0)), driver, 1)["gap"]
    torch.testing.assert_close(driven[-1].squeeze(), torch.tensor(gap), atol=1e-3, rtol=0)


# -- jerk ------------------------------------------------------------------------------------------


def violations(series, bound: float) -> torch.Tensor:
    """Frames beyond the bound, less standstill and logged interventions of the safe cap."""
    capped = series["cap_interventions"].diff(
        dim=0, prepend=torch.zeros_like(series["cap_interventions"][:1])
    )
    stopped = series["speed"][1:] == 0.0
    return (series["jerk"].abs() > bound + 1e-2) & (capped == 0) & ~stopped


def test_jerk_keeps_its_bound_over_every_window(subtests) -> None:
    for actor in ACTORS:
        for bound in [5.0, 30.0]:
            with subtests.test(actor=actor, bound=bound):
                series = play(windows(), hcfs(actor, jerk_bound=bound))
                assert not violations(series, bound).any()


# -- causality -------------------------------------------------------------------------------------

FRAME = 40


def driver(name: str) -> Driver:
    kind, _, mode = name.partition(" ")
    if kind == "deadbeat":
        return deadbeat(mode)
    if kind == "hcfs":
        return hcfs("random", lookahead=mode)
    if kind == "cacc":
        return cacc()
    return Driver(("variant=ddpg",), network(composed("variant=ddpg")))


MODES = ("causal", "hold", "oracle")


@pytest.mark.parametrize(
    "name", ["cacc", "ddpg", *(f"{kind} {mode}" for kind in ("deadbeat", "hcfs") for mode in MODES)]
)
def test_nothing_but_the_oracle_knows_the_future(name) -> None:
    tested = driver(name)
    past = 8.0 + torch.sin(T * torch.arange(61.0))
    other = past.clone()
    other[FRAME + 1 :] = (past[FRAME] + 0.6 * torch.arange(1.0, 21.0)).clamp(max=20.0)
    # Both records in one batch, the same noise for both.
    env = env_of(leader(past, other), tested)
    given = TensorDict({("episode", "seed"): torch.tensor([[3], [3]])}, [2])
    given.set(("leader", "profile"), torch.tensor([[0], [1]]))
    given.set(("leader", "start"), torch.zeros(2, 1, dtype=torch.int64))
    with torch.no_grad():
        data = env.rollout(60, tested.policy, tensordict=env.reset(options=given), auto_reset=False)
    commands = data["next", "vehicles", "command"].flatten(2)
    same = (commands[0] == commands[1]).all(1)
    assert same[:FRAME].all()
    assert bool(same[FRAME]) == ("oracle" not in name)
    assert not same[FRAME + 1 :].all()


# -- safety ----------------------------------------------------------------------------------------


def hard_brake():
    """From 20 m/s at 3 m/s² to standstill, after 4 s."""
    speed = (20.0 - 3.0 * (T * torch.arange(101.0) - 4.0).clamp(min=0.0)).clamp(min=0.0)
    return leader(speed)


@pytest.mark.parametrize("rule", ["tuned", "paper_like"])
@pytest.mark.parametrize("bound", [5.0, 30.0])
def test_no_collision_over_windows_and_hard_braking(rule, bound) -> None:
    for profiles in (windows(), hard_brake()):
        series = play(repeated(profiles, 3), hcfs("mixed", rule, jerk_bound=bound))
        assert series["gap"].min() > 0.0
    # The bad and the random actor did put the cap to the test.
    assert series["cap_interventions"][-1].sum() > 0


@pytest.mark.slow
def test_no_collision_behind_measured_leaders(shared_data) -> None:
    files = [shared_data / f"leader_openacc_platoon{n}_10hz.csv" for n in (3, 10)]
    if not all(file.is_file() for file in files):
        pytest.skip(f"no OpenACC leaders in {shared_data}")
    records = repeated(whole(*((str(file), 1.0) for file in files)), 3)
    series = play(records, wider(hcfs("mixed"), 12), 6)
    assert series["gap"].min() > 0.0


@pytest.mark.slow
def test_without_the_cap_it_drives_through_its_predecessor() -> None:
    # The reward has no spacing term: an actor 10 cm/s too fast wins every frame against CACC.
    steady = leader(8.0 + 1.5 * torch.sin(T * torch.arange(651.0) / 3.0))
    literal = play(steady, hcfs("hasty", "path", safe_cap=False), 3)
    assert literal["gap"].min() <= 0.0
    safe = play(steady, hcfs("hasty", "path"), 3)
    assert safe["gap"].min() > 0.4


@pytest.mark.slow
def test_a_spacing_weight_keeps_a_parent_that_drifts_at_its_place() -> None:
    # The same hasty actor, without the cap: the switch itself takes the rule before it is near.
    steady = leader(8.0 + 1.5 * torch.sin(T * torch.arange(651.0) / 3.0))
    spaced = {"spacing_weight": 0.02, "spacing_time": 5.0}
    kept = play(steady, hcfs("hasty", "path", safe_cap=False, **spaced), 3)
    assert (kept["gap"] - 5.0).abs().max() < 3.0
    # One step of spacing alone moves a gap too little to outweigh the speed.
    literal = play(steady, hcfs("hasty", "path", safe_cap=False, spacing_weight=0.02), 3)
    assert literal["gap"].min() <= 0.0


# -- the hybrid ------------------------------------------------------------------------------------


def test_switching_state_is_carried_by_the_tensordict() -> None:
    tested, profiles = hcfs("random"), ramps()
    series = play(profiles, tested)
    env = env_of(profiles, tested)
    # The seeds that the evaluation gives to its episodes, whose noise the actor draws from.
    count = len(POPULATION.time_gap)
    ids = torch.arange(3)
    given = reset_options(env, ids, ids % count, 0, count)
    with torch.no_grad():
        data = env.rollout(
            100, tested.policy, tensordict=env.reset(options=given), auto_reset=False
        )
    for name in ("winner", "switches", "clamps", "cap_interventions"):
        found = data["next", "hybrid", name].squeeze(-1).transpose(0, 1)
        assert torch.equal(found, series[name]), name
    # Counted from the record of winners: a change is a switch.
    changes = (series["winner"].diff(dim=0) != 0).sum(0)
    assert torch.equal(series["switches"][-1], changes)
    assert changes.sum() > 10
    # A new episode begins anew, whatever is left in the TensorDict from the one before.
    end = step_mdp(data[:, -1])
    end["done"][1] = False
    begun = env.maybe_reset(end)
    assert (begun["hybrid", "switches"][[0, 2]] == 0).all()
    assert (begun["hybrid", "winner"][[0, 2]] == -1).all()
    assert torch.equal(begun["hybrid", "switches"][1], data["next", "hybrid", "switches"][1, -1])


def amplification(series) -> torch.Tensor:
    """Σ e_v(i,i−1)² over that of the vehicle ahead, where that one moves."""
    energy = series["speed_error"].square().sum(0)
    return (energy[:, 1:] / energy[:, :-1])[energy[:, :-1] > 1e-2]


@pytest.mark.parametrize("actor", [*ACTORS, "hasty"])
def test_what_the_first_decides_is_not_amplified_whoever_is_the_parent(actor) -> None:
    # Errors between neighbours obey the rule alone: at every frequency z the error behind is
    # (k1 X + k2 − k1 delay) / (z − 1 + kx X + kv) times the one ahead, X = T/2 (z + 1)/(z − 1).
    k1, k2, k3, k4 = 0.04, 0.12, 1.4, 1.3
    z = torch.exp(1j * torch.logspace(-4, math.log10(math.pi), 2000, dtype=torch.float64))
    place = T / 2 * (z + 1) / (z - 1)
    behind = (k1 * (place - 0.005) + k2) / (z - 1 + (k1 + k3) * place + k2 + k4)
    bound = behind.abs().max().square()
    assert bound < 0.05
    found = amplification(play(windows(), hcfs(actor, choice="first")))
    assert found.max() < bound
    if actor == "random":
        assert amplification(play(windows(), hcfs(actor))).max() > 1.0


def test_the_hybrid_of_good_parents_is_about_as_good_as_the_better() -> None:
    profiles = windows()
    hybrid = play(profiles, hcfs("good"))["reward"].sum()
    good = Driver(("variant=ddpg",), Actor("good"))
    parents = [play(profiles, p)["reward"].sum() for p in (cacc(), good)]
    assert hybrid >= 1.1 * max(parents)  # rewards are negative: 10 %


@pytest.mark.parametrize("choice", ["better", "between", "first"])
def test_the_hybrid_brakes_where_what_it_measures_is_no_number(choice) -> None:
    hybrid = HCFS(rule=CACC(), choice=choice).bind(World(parse_string("automated*2"), T))
    unused = {"first": "action"}  # that of the second vehicle
    errors = ("speed_error", "leader_gap_error")
    for name in ("action", "speed", "acceleration", "received_gap", *errors):
        entries = []
        for key in hybrid.names:
            value = torch.full((1, 2, 1), 20.0 if key == "self.received_gap" else 0.0)
            if key.endswith(f".{name}"):
                value[0, 1] = torch.nan
            entries.append(value)
        command, *_ = hybrid.command(*entries)
        assert (command[0, 1] == -A_MAX) == (name != unused.get(choice)), name
        assert command[0, 0] > -A_MAX


# -- human drivers in between ----------------------------------------------------------------------

MIXED = parse_string("automated*2 human automated*2")


def heard(delay: float, leader_sends: bool = True):
    """What is heard in one mixed string; speeds, gaps and accelerations as written here."""
    piece = Communication(leader_sends=leader_sends, delay=delay).bind(World(MIXED))
    speed = torch.tensor([10.0, 11.0, 8.0, 9.0, 12.0]).view(1, 5, 1)
    gap = torch.tensor([6.0, 4.0, 20.0, 7.0, 5.5]).view(1, 5, 1)
    acceleration = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5]).view(1, 5, 1)
    entries = piece.compute(
        speed, gap, acceleration, torch.tensor([[13.0]]), torch.tensor([[-0.6]])
    )
    return {
        key[1]: value.flatten().tolist() for key, value in zip(piece.out_keys, entries, strict=True)
    }


def test_behind_a_human_driver_that_one_leads_the_chain() -> None:
    known = heard(0.0)
    assert known["leader_speed"] == pytest.approx([13.0, 13.0, 11.0, 8.0, 8.0])
    assert known["leader_acceleration"] == pytest.approx([-0.6, -0.6, 0.2, 0.3, 0.3])
    assert known["leader_speed_error"] == pytest.approx([3.0, 2.0, 3.0, -1.0, -4.0])
    assert known["speed_error"] == pytest.approx([3.0, -1.0, 3.0, -1.0, -3.0])
    # Gaps less 5 m: 1, −1, 15, 2, 0.5; summed within each chain.
    assert known["gap_error"] == pytest.approx([1.0, -1.0, 15.0, 2.0, 0.5])
    assert known["leader_gap_error"] == pytest.approx([1.0, 0.0, 15.0, 2.0, 2.5])
    assert known["received_gap"] == pytest.approx([6.0, 4.0, 20.0, 7.0, 5.5])


def test_only_what_came_by_radio_is_delayed() -> None:
    # 0.1 s: messages of the vehicle ahead (13, 10, ·, ·, 9 m/s) and of the chain's leader.
    late, now = heard(0.1), heard(0.0)
    change = [a - b for a, b in zip(late["gap_error"], now["gap_error"], strict=True)]
    assert change == pytest.approx([-1.3, -1.0, 0.0, 0.0, -0.9], abs=1e-5)
    change = [a - b for a, b in zip(late["leader_gap_error"], now["leader_gap_error"], strict=True)]
    assert change == pytest.approx([-1.3, -1.3, 0.0, 0.0, -0.8], abs=1e-5)
    assert late["speed_error"] == now["speed_error"]
    # A leader of the string that does not send is seen by the first one's sensors.
    silent = heard(0.1, leader_sends=False)
    assert silent["gap_error"] == pytest.approx([1.0, -2.0, 15.0, 2.0, -0.4], abs=1e-5)
    assert silent["leader_speed"] == now["leader_speed"]


def test_cacc_in_a_mixed_string_obeys_the_law_by_hand() -> None:
    cfg = composed("variant=cacc", string("automated*2 human automated*2"))
    env = build_env(cfg, wavy_profiles(), POPULATION, 3)
    data = env.rollout(20, break_when_any_done=False)
    gains, now = Gains(0.04, 0.12, 1.4, 1.3), data["vehicles"]
    speed, gap = now["speed"][..., 0], now["gap"][..., 0]
    # The fourth vehicle is the first behind a human driver: both errors are those to the human.
    change = (gains.k1 + gains.k3) * (gap[..., 3] - 5.0)
    change = change + (gains.k2 + gains.k4) * (speed[..., 2] - speed[..., 3])
    wanted = (change / T).clamp(-3.0, 3.0)
    found = data["next", "vehicles", "command"][..., 3, 0]
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)
    # The last one hears it, and of the human only what it knows of the fourth.
    received = gap[..., 4] - 5.0 - 0.005 * speed[..., 3]
    total = gap[..., 3] + gap[..., 4] - 10.0 - 0.005 * speed[..., 2]
    change = gains.k1 * received + gains.k2 * (speed[..., 3] - speed[..., 4])
    change = change + gains.k3 * total + gains.k4 * (speed[..., 2] - speed[..., 4])
    wanted = (change / T).clamp(-3.0, 3.0)
    found = data["next", "vehicles", "command"][..., 4, 0]
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)


def test_the_first_decides_for_one_platoon_only() -> None:
    words = "choice=first needs a string that is one platoon, but the string has automated, human"
    with pytest.raises(ConfigError, match=words):
        HCFS(rule=CACC(), choice="first").bind(World(MIXED, T))


class Learned(HCFS):
    def choose(self, rule, learned, *entries):
        return torch.ones_like(rule, dtype=torch.bool)


def test_the_hybrid_has_the_limits_of_its_vehicles_and_the_policy_of_its_training() -> None:
    def bound(kind: type = HCFS, limit: float = 3.0, **settings: float) -> HCFS:
        world = World(parse_string("automated*2"), T, max_braking=limit, max_acceleration=limit)
        return kind(rule=CACC(), **settings).bind(world)

    given = ({}, {"limit": 2.0}, {"limit": 6.0}, {"max_acceleration": 2.0}, {"braking": 1.0})
    assert [bound(**x).both_brake.own for x in given] == [3.0, 2.0, 6.0, 2.0, 1.0]
    stronger = r"deployed\.braking=3 exceeds the brakes of the vehicles, 2 m/s² \(scenario\.max_br"
    cases = [({x: 2.0, "braking": 3.0}, stronger) for x in ("limit", "max_acceleration")]
    cases += [({"max_acceleration": 5.0}, r"deployed\.max_acceleration=5 exceeds the limits")]
    check_refused(lambda given: bound(**given), cases, ConfigError)
    same = [({"max_acceleration": 2.0}, [1.5, 2.0]), ({"limit": 6.0}, [1.5, 3.0])]
    for settings, expected in [*same, ({"action_scale": 1.0}, [0.5, 1.0])]:
        hybrid, reached = bound(Learned, **settings), {}
        values = dict.fromkeys((key for _, key in hybrid.needs), torch.ones(2, 1))
        values["automated", "action"] = torch.tensor([[0.5], [1.0]])
        hybrid.derive(values, reached)
        assert reached["automated", "command"].flatten().tolist() == expected
    for word, expected in (("deployed", 3.0), ("scenario.controllers.automated", 2.0)):
        cfg = composed("variant=hcfs", f"{word}.max_acceleration=2").after_training()
        assert cfg.scenario.controllers["automated"].settings["action_scale"] == expected


def test_a_reward_by_which_hcfs_does_not_compare_is_refused() -> None:
    own = "+reward.terms.mine={_target_: lcc_rl.pieces.SafetyReward}"
    env_of(ramps(), Driver(("variant=ddpg", own)))
    with pytest.raises(ConfigError, match=r"jerk and spacing only, not by reward\.terms\.mine:"):
        env_of(ramps(), Driver((*hcfs().overrides, own)))


def test_an_evaluation_with_sensors_names_who_reads_messages(caplog) -> None:
    cfg = load("evaluate", ["variant=cacc", "+faults=sensors", "scenario.horizon=20"])
    inputs = Inputs(ramps(), ramps(), POPULATION)
    both = [Strategy("cacc tuned", cfg), baseline(cfg, "idm_acc")]
    Comparison(cfg, inputs, both)
    text = "sensors change no messages, which are read by CACC, tuned"
    assert [x for x in caplog.messages if "messages" in x] == [text]
    caplog.clear()
    Comparison(load("evaluate", ["variant=cacc", "scenario.horizon=20"]), inputs, [both[1]])
    assert not caplog.messages


def test_an_evaluation_names_a_role_that_reads_messages_without_being_connected(caplog) -> None:
    words = ["variant=cacc", "+controller@scenario.controllers.truck=cacc", "scenario.horizon=20"]
    words += ["+scenario.start.truck=${scenario.start.automated}", string("automated*2 truck")]
    option, inputs = "scenario.pieces.communication.connected", Inputs(ramps(), ramps(), POPULATION)

    def warned(*more: str) -> list[str]:
        caplog.clear()
        cfg = load("evaluate", [*words, *more])
        Comparison(cfg, inputs, [Strategy("cacc tuned", cfg)])
        return [x for x in caplog.messages if option in x]

    assert warned() == [f"truck reads messages but is not in {option}"]
    assert warned(f"{option}=[automated,truck]") == []
    with pytest.raises(ConfigError, match=rf"unknown role \({option}\) 'trick'.*; valid: .*truck"):
        warned(f"{option}=[automated,trick]")


def test_a_headway_below_the_deviations_of_training_is_refused_in_training_only() -> None:
    cfg = composed("variant=cacc", "scenario.start.automated.headway=1", "scenario.horizon=20")
    build_env(cfg, ramps(), POPULATION, 2, nominal=True)
    with pytest.raises(
        ConfigError, match=r"start\.automated\.gap_spread=2 must be below its headw"
    ):
        build_env(cfg, ramps(), POPULATION, 2)


# -- the headway and the safe cap ------------------------------------------------------------------


def fast(speed: float) -> Profiles:
    time = T * torch.arange(101)
    return leader(*(speed + a * torch.sin(time / p) for a, p in ((1.5, 1.5), (2.0, 3.0))))


def test_a_headway_that_the_safe_cap_contradicts_is_refused_with_the_remedy() -> None:
    words = (
        r"leader drives 32\.0 m/s \(leader1\): the safe cap of HCFS then needs a gap of 7\.06 m, "
        r"the platoon keeps a headway of 5 m, enough up to 22\.0 m/s; use "
        r"scenario\.start\.automated\.headway=10$"
    )
    with pytest.raises(ConfigError, match=words):
        play(fast(30.0), hcfs())
    play(fast(19.9).select([1]), hcfs())  # 21.9 m/s
    play(fast(30.0), hcfs(safe_cap=False))
    play(fast(30.0), cacc())
