"""Physics that must hold for any drivers, profiles and actions, searched for with hypothesis."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from helpers import ACTION, OBSERVATION, POPULATION, REWARD, compose, wavy_profiles
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from lcc_rl.envs import build_env
from lcc_rl.evaluation.metrics import energy_measures
from lcc_rl.functional.driver_models import simulate_follower
from lcc_rl.functional.idm import IDMConstants
from lcc_rl.functional.power import motor_power
from lcc_rl.functional.string import entries_ahead

QUICK = settings(
    max_examples=5, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True
)
STEPS, STEP = 20, 0.1


def played(batch: int, actions: torch.Tensor, choices: TensorDict, profiles=None):
    """Play actions ``[steps]`` in a batch with given seeds, profiles, starts and drivers."""
    env = build_env(compose("alcc"), profiles or wavy_profiles(), POPULATION, batch, nominal=True)
    start = env.reset(options=choices)
    number = iter(range(len(actions)))

    def policy(td):
        return td.set(ACTION, actions[next(number)].expand(batch, 1, 1).clone())

    return env.rollout(STEPS, policy, auto_reset=False, tensordict=start, break_when_any_done=False)


def some_choices(seeds: list[int]) -> TensorDict:
    """Return the choices of episodes that follow from their seeds."""
    batch = len(seeds)
    numbers = torch.tensor(seeds).view(-1, 1)
    return TensorDict(
        {
            ("episode", "seed"): numbers,
            ("leader", "profile"): numbers % 4,
            ("leader", "start"): numbers % 50,
            ("human", "driver"): (numbers % len(POPULATION.time_gap)).view(-1, 1, 1),
        },
        batch_size=[batch],
    )


seeds = st.lists(st.integers(0, 2**31), min_size=2, max_size=5)
actions = st.lists(st.floats(-1, 1), min_size=STEPS, max_size=STEPS).map(torch.tensor)


@QUICK
@given(seeds, actions)
def test_speeds_are_never_negative_and_gaps_change_by_relative_motion(numbers, given_actions):
    data = played(len(numbers), given_actions, some_choices(numbers))
    now, after = data["vehicles"], data["next", "vehicles"]
    lead, lead_after = (
        entries_ahead(part["leader", "speed"], part["vehicles", "speed"])
        for part in (data, data["next"])
    )
    assert (after["speed"] >= 0).all()
    change = after["gap"] - now["gap"]
    closing = (lead - now["speed"]) + (lead_after - after["speed"])
    torch.testing.assert_close(change, 0.5 * STEP * closing, rtol=0, atol=1e-4)


@QUICK
@given(seeds, actions, st.randoms(use_true_random=False))
def test_permuted_members_give_permuted_results(numbers, given_actions, chance) -> None:
    order = list(range(len(numbers)))
    chance.shuffle(order)
    one = played(len(numbers), given_actions, some_choices(numbers))
    two = played(len(numbers), given_actions, some_choices([numbers[i] for i in order]))
    for key in (OBSERVATION, REWARD):
        assert torch.equal(one["next", *key][order], two["next", *key])


@QUICK
@given(seeds, actions)
def test_a_larger_batch_does_not_change_a_member(numbers, given_actions) -> None:
    one = played(len(numbers), given_actions, some_choices(numbers))
    two = played(2 * len(numbers), given_actions, some_choices(numbers + numbers))
    # Vectorised kernels may round differently at other sizes: 1e-5 is a hundred times less than
    # what a step changes.
    torch.testing.assert_close(
        two["next", *OBSERVATION][: len(numbers)], one["next", *OBSERVATION], rtol=1e-5, atol=1e-5
    )


@QUICK
@given(st.lists(st.floats(0.5, 30.0), min_size=3, max_size=40))
def test_energy_is_steady_driving_and_loss_and_what_the_last_speed_stores(speeds) -> None:
    """A2's account: the part with a is the derivative of a function of the speed alone."""
    fine = 1e-3  # [s]; the parts add up in the limit of short steps
    ramp = [torch.linspace(a, b, 2001, dtype=torch.float64)[:-1] for a, b in pairwise(speeds)]
    speed = torch.cat([*ramp, torch.tensor(speeds[-1:], dtype=torch.float64)]).view(-1, 1, 1)
    power = motor_power(speed[:-1], speed.diff(dim=0) / fine)
    alive = torch.ones(len(speed) - 1, 1, 1, dtype=torch.bool)
    found = {k: v.item() for k, v in energy_measures(power, speed, alive, fine).items()}
    first, last = speeds[0], speeds[-1]
    stored = 1213 * (last - first) + 2484 / 2 * (last**2 - first**2)
    stored += 1.374 / 3 * (last**3 - first**3)
    parts = found["steady_energy_kj"] + found["acceleration_loss_kj"] + stored / 1e3
    assert found["energy_kj"] == pytest.approx(parts, rel=1e-2, abs=0.1)


def slopes(speed, time_gap, constants: IDMConstants):
    """Return the derivatives of the IDM by gap, own speed and leader's speed in equilibrium."""
    own, lead = speed.clone().requires_grad_(), speed.clone().requires_grad_()
    desired = torch.full_like(speed, 30.0)
    gap = constants.equilibrium_gap(speed, desired, time_gap, 100.0).requires_grad_()
    law = constants(own, gap, own - lead, desired, time_gap)
    return torch.autograd.grad(law.sum(), (gap, own, lead))


@pytest.mark.parametrize("acceleration", [1.0, 2.0])
def test_strings_amplify_exactly_where_the_linear_criterion_says(acceleration) -> None:
    """The slow-wave criterion (Treiber and Kesting 2013, chapter 15) decides what grows.

    A time gap above 1 s alone does not make a string stable: with a = 1 m/s² it takes more.
    """
    constants = IDMConstants(acceleration=acceleration)
    speed, gap_time = torch.meshgrid(
        torch.tensor([5.0, 10.0, 20.0]), torch.tensor([0.8, 1.1, 1.5, 2.0, 2.5]), indexing="ij"
    )
    speed, time_gap = speed.flatten().double(), gap_time.flatten().double()
    by_gap, by_speed, by_lead = slopes(speed, time_gap, constants)
    # |transfer|² = 1 + ω² (2 f_s − f_v² + f_l²) / f_s² + … for slow waves.
    growth = 2 * by_gap - by_speed**2 + by_lead**2
    waves = torch.tensor([0.05, 0.1, 0.2, 0.4], dtype=torch.float64).view(-1, 1)
    moment = torch.arange(0, 3000).double() * STEP
    lead = speed + 0.2 * torch.sin(waves * moment.view(-1, 1, 1))
    shape = lead.shape[1:]
    gap = constants.equilibrium_gap(speed, torch.full_like(speed, 30.0), time_gap, 100.0)
    desired = torch.tensor(30.0, dtype=torch.float64)
    own, _, _ = simulate_follower(
        lead, speed.expand(shape), gap.expand(shape), desired, time_gap, constants, STEP
    )
    settled = own[1500:]
    ratio = (settled.amax(0) - settled.amin(0)) / 0.4  # [waves, settings]
    stable, unstable = growth < -0.01, growth > 0.01
    assert stable.any()
    # Half a per cent for the finite step and the second order of the wave.
    assert (ratio[:, stable] < 1.005).all()
    assert (ratio[:, unstable].amax(0) > 1.0).all()
    assert not stable[(time_gap < 1.0) & (speed < 6)].any() or acceleration > 1
