"""Differentiable rollouts: the same entries as a rollout, and gradients that are right."""

from __future__ import annotations

import gc
import logging
import os
from dataclasses import replace
from shutil import which
from typing import Any
from unittest.mock import patch

import pytest
import torch
from helpers import (
    ACTION,
    OBSERVATION,
    POPULATION,
    REWARD,
    TERMS,
    compose,
    followers,
    make_agent,
    small_env,
    string,
    wavy_profiles,
)
from torchrl.envs import TransformedEnv

from lcc_rl.agents.actor import make_actor, shared_policy
from lcc_rl.data.profiles import Profiles
from lcc_rl.envs import DifferentiableRollout, build_env
from lcc_rl.envs.compiled import CACHE_LOG, Compiled, Traced

WANTED = [("vehicles", name) for name in ("gap", "power", "relative_speed")]
OBSERVED = [REWARD, (*TERMS, "hdv_energy"), (*TERMS, "safety")]


FILTER, SEVERAL = "+filter=cbf", string("human (automated human)*2")


@pytest.mark.parametrize(
    ("variant", "more"),
    [*(("alcc", x) for x in (followers(1), followers(3), SEVERAL, FILTER)), ("reference", FILTER)],
)
def test_entries_equal_those_of_a_rollout(variant, more) -> None:
    # From such gaps nobody collides, after which a rollout would begin anew.
    overrides = [more, "training.gap_range=[0.8,1.5]"]
    observed = OBSERVED if variant == "alcc" else [REWARD, (*TERMS, "safety")]
    policy = make_agent(compose(variant, *overrides)).policy
    with torch.no_grad():
        env = small_env(variant, 5, overrides, seed=3)
        expected = env.rollout(20, shared_policy(policy), break_when_any_done=False)
        env = small_env(variant, 5, overrides, seed=3)
        unrolled = DifferentiableRollout(env, policy.module, WANTED, observed)
        _, record = unrolled.play(unrolled.start(), 20)
        got = unrolled.assemble(record)
    for key in [*WANTED, *observed, ("done",), ("terminated",), OBSERVATION]:
        assert torch.equal(got.get(("next", *key)), expected.get(("next", *key))), key
    assert torch.equal(got[ACTION], expected[ACTION])


def total_power(env: TransformedEnv, network, seed: int = 0) -> torch.Tensor:
    env.set_seed(seed)
    unrolled = DifferentiableRollout(env, network, [("vehicles", "power")])
    _, record = unrolled.play(unrolled.start(), 20)
    return unrolled.assemble(record)["next", "vehicles", "power"].sum() / 20000.0


def in_float64(population: Any, profiles: Profiles) -> tuple[Any, Profiles]:
    """Return drivers and profiles in double precision, from which all motion inherits it."""
    drivers = replace(
        population,
        desired_speed=population.desired_speed.double(),
        time_gap=population.time_gap.double(),
    )
    return drivers, replace(profiles, speeds=profiles.speeds.double())


# Half of the vehicles are trucks, which keep to 9 m/s.
TRUCKS = (
    *("+fleet=trucks", "scenario.fleet.truck.share=0.5", "scenario.fleet.truck.speed_limit=9"),
    "scenario.fleet.truck.roles=[automated,human]",
)


@pytest.mark.parametrize("fleet", [(), TRUCKS])
def test_gradient_equals_finite_differences(fleet) -> None:
    # 20 steps of leader, car, three human drivers and the observation, in float64.
    cfg = compose("alcc", followers(3), *fleet)
    population, profiles = in_float64(POPULATION, wavy_profiles())
    with patch("lcc_rl.envs.factory.check_pieces"):  # whose specs are those of float32
        env = build_env(cfg, profiles, population, 4)
    network = make_actor(7, 1, (8,), 0).module.to(torch.float64)
    assert total_power(env, network).dtype == torch.float64
    total_power(env, network).backward()
    generator = torch.Generator().manual_seed(0)
    for weight in network.parameters():
        direction = torch.randn(weight.shape, generator=generator, dtype=torch.float64)
        step = 1e-5
        with torch.no_grad():
            weight += step * direction
            above = total_power(env, network)
            weight -= 2 * step * direction
            below = total_power(env, network)
            weight += step * direction
        slope = float((weight.grad * direction).sum())
        assert slope == pytest.approx(float(above - below) / (2 * step), rel=1e-5, abs=1e-8)


def test_gradients_are_finite_through_contact_and_standstill() -> None:
    env = small_env("alcc", 64, ["scenario.horizon=100"])
    for bias in (9.0, -9.0):  # into the leader; to a halt
        network = make_actor(7, 1, (8,), 0).module
        with torch.no_grad():
            network[0][-1].bias.fill_(bias * 0.1)
        unrolled = DifferentiableRollout(env, network, WANTED)
        _, record = unrolled.play(unrolled.start(), 100)
        data = unrolled.assemble(record)
        if bias > 0:
            assert data["next", "terminated"].any()
        sum(data["next"].get(key).mean() for key in WANTED).backward()
        assert all(torch.isfinite(weight.grad).all() for weight in network.parameters())


@pytest.mark.skipif(torch.backends.cpu.get_cpu_capability() != "AVX512", reason="no such processor")
def test_processors_that_share_a_cache(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    numbers = torch.arange(64.0)
    for processor in ("AVX512", "AVX2"):
        monkeypatch.setenv("ATEN_CPU_CAPABILITY", processor.lower())
        monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: processor)  # noqa: B023
        torch.compiler.reset()
        half = Compiled(lambda numbers: numbers / 2 + 1, "a half", compiled=True)
        assert (half(numbers) == numbers / 2 + 1).all()
        assert half.function is not half.plain


def test_a_damaged_file_of_torchs_cache_is_no_traceback(capfd) -> None:
    Compiled(abs, "a number", compiled=True)
    try:
        raise EOFError
    except EOFError:  # as torch does, before it compiles anew
        logging.getLogger(CACHE_LOG).warning("unable to load compiled graph", exc_info=True)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("batch", "rest"), [(64, False), (5, True)])
def test_compilation_leaves_out_what_costs_seconds(batch, rest, monkeypatch) -> None:
    seen = []

    def compiled(graph: Any, inputs: list[torch.Tensor], options: dict[str, Any]) -> Any:
        seen.append((options, gc.isenabled()))
        return graph

    monkeypatch.setattr("torch._inductor.compile", compiled)
    row = torch.rand(7, batch)
    assert torch.equal(*Traced(lambda x: (x + 1.0,), "a sum", True)(row), row + 1.0)
    ((options, collected),) = seen
    assert options["cpp.enable_loop_tail_vec"] is rest  # kernels of tails, where there are none
    assert not collected
    assert gc.isenabled()


@pytest.mark.slow
@pytest.mark.parametrize("fleet", [(), TRUCKS, ("scenario.string={size: 6, penetration: 0.5}",)])
@pytest.mark.filterwarnings("ignore")  # the compiler warns of much
def test_compiled_equals_eager_over_an_episode(fleet) -> None:
    if which(os.environ.get("CXX", "g++")) is None:
        pytest.skip("no compiler on this machine")
    envs = [small_env("alcc", 8, ["scenario.horizon=100", *fleet]) for _ in range(2)]
    size = envs[0].full_observation_spec[OBSERVATION].shape[-1]
    network = make_actor(size, 1, (16,), 0).module
    plain, fast = (
        DifferentiableRollout(env, network, WANTED, OBSERVED, compiled=c)
        for env, c in zip(envs, (False, True), strict=True)
    )
    rolls = [u.assemble(u.play(u.start(), 100)[1])["next"] for u in (plain, fast)]
    for key in [("vehicles", "gap"), ("vehicles", "speed")]:
        assert torch.allclose(rolls[0].get(key), rolls[1].get(key), rtol=1e-5, atol=1e-5), key
    slopes = []
    for roll in rolls:
        network.zero_grad()
        (2.0 * roll["vehicles", "power"].mean()).backward()
        slopes.append(torch.cat([w.grad.flatten() for w in network.parameters()]).clone())
    assert torch.allclose(slopes[0], slopes[1], rtol=1e-3, atol=1e-4 * float(slopes[0].norm()))
    assert all(part.function is not part.plain for part in (fast.drive, fast.pull))
