"""A leader that another vehicle replaces: cut-in, cut-out; a target that is lost."""

from __future__ import annotations

import pytest
import torch
from helpers import ACTION, POPULATION, check_refused, composed, play, wavy_profiles
from torch import Tensor

from lcc_rl.data.profiles import from_records
from lcc_rl.envs import build_env
from lcc_rl.envs.factory import build_pieces, world_of
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.metrics import safety_measures
from lcc_rl.evaluation.rollout import warn_of_idle
from lcc_rl.evaluation.simulation import simulate
from lcc_rl.evaluation.strategies import applies
from lcc_rl.pieces import ReplacedLeader

LEADER = "scenario.pieces.leader"
ROAD = [("leader", "speed"), ("leader", "acceleration")]
SENSED = tuple(f"sensed_{name}" for name in ("gap", "speed", "ahead_speed"))
OWN = [("automated", name) for name in ("promised", "safe", "command", "sensors", *SENSED)]
KEYS = [*ROAD, *OWN, *(("vehicles", name) for name in ("gap", "speed", "ttc", "followed"))]
STEADY = from_records([torch.full((400,), 15.0)], ["steady@0s"], ["steady"], 0.1)


def config(*words: str):
    return composed("variant=alcc", "scenario.horizon=150", *words)


def event(kind: str, **settings: object) -> list[str]:
    return [
        f"+event={kind}",
        *(f"{LEADER}.{key}={x}".replace(" ", "") for key, x in settings.items()),
    ]


def driven(words: list[str], action: float = 0.0, profiles=None) -> dict[str, Tensor]:
    """Drive four episodes with a constant action; entries ``[time, 4, …]`` by name."""
    env = build_env(config(*words), profiles or STEADY, POPULATION, 4, nominal=True)
    full = torch.full((4, 1, 1), action)
    record, alive = play(env, lambda td: td.set(ACTION, full), None, KEYS)
    return {
        name if space != "leader" else f"leader_{name}": x for (space, name), x in record.items()
    } | {"alive": alive}


def test_a_vehicle_cuts_in_at_the_given_time_gap_and_speed() -> None:
    for kind, change in (("cut_in", "gap=[9,9]"), ("cut_out", "farther=[30,30]")):
        words = [*event(kind, at=[3, 3], excess=[-2, -2]), f"{LEADER}.{change}"]
        found, gap = driven(words), None
        gap = found["gap"][:, :, 0, 0]
        before = gap[28]
        expected = torch.full((4,), 9.0) if kind == "cut_in" else before + 30.0
        assert torch.allclose(gap[29], expected, atol=0.2), kind
        speed = found["leader_speed"][:, 0, 0]  # also before the first step
        assert speed[29] == 15.0
        assert speed[30] == pytest.approx(13.0)
        assert speed[80] == pytest.approx(15.0 - 2.0 * torch.exp(torch.tensor(-1.0)).item(), 1e-4)
        # The acceleration is the new vehicle's, not the difference between the two.
        assert found["leader_acceleration"].abs().max() == pytest.approx(0.4, rel=0.02)
        assert found["followed"][28:31, 0, 0, 0].tolist()[1:] == [0.0, 1.0]
    nearer = driven([*event("cut_in", at=[3, 3]), f"{LEADER}.gap=[500,500]"])["gap"]
    assert (nearer[29, :, 0] - nearer[28, :, 0]).abs().max() < 1.0  # never beyond the leader


def test_an_event_that_never_happens_is_one_line(caplog) -> None:
    """Of cut-ins that change no gap, of all strategies together; a lost target happens here."""
    words = event("[cut_in,lost_target]", at=[3, 3], gap=[500, 500])
    words.append("scenario.sensors.automated.lost_from=4")
    simulate([15.0] * 101, "automated", "idm_acc", overrides=words)
    assert caplog.text.count("happened in no episode") == caplog.text.count("ReplacedLeader") == 1
    warn_of_idle([{"A": True, "B": True}, {}, {"A": True, "B": False}])
    assert [x for x in "AB" if f"event of {x}" in caplog.text] == ["A"]
    caplog.clear()
    words[2] = f"{LEADER}.gap=[5,5]"
    simulate([15.0] * 101, "automated", "idm_acc", overrides=words)
    assert "happened in no episode" not in caplog.text


def test_every_episode_draws_its_own_change() -> None:
    found = driven(event("cut_in", at=[2, 12], gap=[5, 15]), profiles=wavy_profiles())
    assert len({int((found["followed"][:, i, 0, 0] == 0.0).nonzero()[0]) for i in range(4)}) > 2
    assert (found["followed"][:, :, 0] == 0.0).sum() == 4


def test_the_guarantee_covers_no_step_that_a_cut_in_makes_unsafe() -> None:
    close = driven(["+filter=cbf", *event("cut_in", at=[3, 3], gap=[3, 3], excess=[-4, -4])], 1.0)
    promised, safe = close["promised"][:, :, 0, 0], close["safe"][:, :, 0, 0]
    assert (promised[:29] == 1.0).all()
    assert (promised[29:35] == 0.0).all()
    assert (safe[30:35] == 0.0).all()
    assert (close["command"][30:35] == -3.0).all()
    assert (promised[-1] == 1.0).all(), "it covers the steps again once the vehicle is safe"
    alive = close["alive"].unsqueeze(-2)
    own = {name: close[name][:, :, :1] for name in ("promised", "safe", "ttc", "gap")}
    own["speed"] = close["speed"][:, :, :1]
    found = safety_measures(own, alive, 0.1)
    assert found["share_turned_unsafe"].min() > 0.0
    assert found["share_promise_broken"].max() == 0.0


def test_the_filter_does_not_brake_for_a_harmless_change() -> None:
    """A gap that jumps is no relative speed."""
    for kind, change in (("cut_in", {"gap": [14, 14]}), ("cut_out", {"farther": [20, 20]})):
        words = ["+filter=cbf", *event(kind, at=[3, 3], excess=[0, 0], **change)]
        found = driven(words)
        after = found["command"][29:60, :, 0, 0]
        assert after.min() > -1.0, kind
        assert (found["promised"][31:] == 1.0).all()


def test_a_lost_target_keeps_its_last_measurement_and_the_guarantee() -> None:
    lost = ["+filter=cbf", "+event=lost_target", "scenario.sensors.automated.lost_from=4"]
    found = driven(lost, 1.0, wavy_profiles())
    sensed = found["sensed_gap"][:, 0, 0, 0]
    changes = (sensed.diff() != 0.0).nonzero().flatten() + 1
    gone = sorted(set(range(30, 80)) - set(changes.tolist()))
    assert gone == list(range(40, 60))
    assert torch.equal(found["sensed_speed"], found["speed"][-len(sensed) :, :, :1])
    assert found["sensed_ahead_speed"][40:60].diff(dim=0).abs().max() == 0.0
    promised = found["promised"][..., 0] == 1.0
    assert promised.double().mean() > 0.9
    assert (found["ttc"][:, :, :1, 0][promised] >= 4.0).all()


def test_a_target_is_lost_as_long_beside_faults_of_sensors() -> None:
    both = ["+event=lost_target", "+faults=sensors"]
    one, other = config(*both), config(*both[::-1])
    assert one.scenario.sensors == other.scenario.sensors
    exact = [f"{x}=0" for x in ("gap_error", "speed_error", "ahead_error")]
    words = [f"scenario.sensors.automated.{x}" for x in ("lost_from=4", "dropouts=0.5", *exact)]
    found = driven([*both, *words], 1.0, wavy_profiles())
    held = found["sensed_gap"][..., 0, 0].diff(dim=0) == 0.0
    target, own = found["sensors"][..., 0, :2].unbind(-1)
    assert (own <= target).all()  # the filter assumes it
    assert held[39:59].all()  # no measurement arrives during the loss
    longest = torch.zeros(4, dtype=torch.long)
    run = longest.clone()
    for step, still in enumerate(held[5:], 5):
        run = torch.where(still, run + 1, 0)
        assert step in range(39, 66) or run.max() <= 4  # a drop-out ends after 0.4 s
        longest = longest.maximum(run)
    assert (longest <= 28).all()  # a drop-out may precede the loss, another one outlast it


def test_a_memory_starts_anew_behind_another_vehicle() -> None:
    for kind in ("filtered", "stacked"):
        words = ["+knowledge=memory", f"scenario.pieces.memory.kind={kind}"]
        words += event("cut_in", at=[1, 1], gap=[6, 6], excess=[-5, -5])
        env = build_env(config(*words), STEADY, POPULATION, 2, nominal=True)
        td = env.rollout(12, lambda td: td.set(ACTION, torch.zeros(2, 1, 1)))["next"]
        entries = td["memory", "entries"]
        assert torch.allclose(entries[:, 8], torch.tensor(15.0)), kind
        assert torch.allclose(entries[:, 9], torch.tensor(10.0)), kind


def test_what_does_not_fit_is_refused() -> None:
    def built(*words: str) -> None:
        cfg = config(*words)
        build_pieces(cfg, world_of(cfg, STEADY, POPULATION))

    cut, lost = "+event=cut_in", "+event=lost_target"
    never = f"{lost} scenario.sensors.automated.lost_for=0"
    cases = {
        f"{cut} {LEADER}.at=[20,30]": r"leader.at=\[20.* 15 s \(scenario.hor",
        f"{cut} +{LEADER}.farther=[1,2]": r"give gap \(cut-in\) or farther",
        f"{cut} {LEADER}.at=[2,3] +knowledge=preview": "a preview reads the rec",
        never: "lost_from and lost_for belong together",
        lost: r"lost_from=30.0 must lie within the episode of 15 s .*lost_from=2",
    }
    check_refused(lambda words: built(*words.split()), cases.items(), ConfigError)
    with pytest.raises(ConfigError, match="must not fall"):
        ReplacedLeader(gap=(5.0, 4.0))
    assert applies(config(), "recorded")
    assert not applies(config("+event=cut_in"), "recorded")
