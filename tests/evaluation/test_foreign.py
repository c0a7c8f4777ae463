"""Policies that other libraries trained: by their keys, with memory, and what is refused."""

from __future__ import annotations

from functools import partial
from itertools import count

import numpy as np
import pytest
import torch
from commands import NO_AGENT
from helpers import check_refused, slow_but
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs.transforms import CatFrames, VecNorm, VecNormV2
from torchrl.modules import (
    GRUModule,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    TruncatedNormal,
)

import lcc_rl
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.foreign import as_given

pytestmark = pytest.mark.filterwarnings("ignore:(The VecNorm|This) class is to be deprecated")
EXPERIMENTAL = pytest.mark.filterwarnings("ignore:Support of VecNormV2")
ROOT, GROUP = (["observation"], ["action"]), (["automated", "observation"], ["automated", "action"])
SMALL = [*NO_AGENT, "evaluation.baselines=[]"]
WIDTH = 7
STRINGS = ["automated human", "automated human automated human"]


class Lagged(nn.Module):
    """A network of what was observed a step before, which it remembers."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: Tensor, begins: Tensor, before: Tensor | None = None):
        before = observation if before is None else before
        assert begins.shape == (*observation.shape[:-1], 1)
        return self.network(before), observation


def networks() -> tuple[nn.Sequential, dict[str, nn.Module]]:
    torch.manual_seed(0)
    linear = nn.Linear(WIDTH, 1)
    network = nn.Sequential(linear, nn.Tanh())
    mean = nn.Linear(WIDTH, 2)  # before the tanh, and a wide distribution
    last, earlier = nn.Linear(2 * WIDTH, 1), nn.Linear(2 * WIDTH, 1)
    with torch.no_grad():
        mean.weight.copy_(torch.cat([linear.weight, torch.zeros(1, WIDTH)]))
        mean.bias.copy_(torch.cat([linear.bias, torch.ones(1)]))
        for one, part in ((last, slice(WIDTH, None)), (earlier, slice(WIDTH))):
            one.weight.zero_()[:, part] = linear.weight
            one.bias.copy_(linear.bias)
    spread = TensorDictModule(
        nn.Sequential(mean, NormalParamExtractor()), ["observation"], ["loc", "scale"]
    )
    frames = CatFrames(N=2, dim=-1, in_keys=["observation"], out_keys=["frames"])
    return network, {
        "root": TensorDictModule(network, *ROOT),
        "group": TensorDictModule(network, [tuple(GROUP[0])], [tuple(GROUP[1])]),
        "drawn": ProbabilisticActor(
            spread, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True
        ),
        "last frame": TensorDictSequential(
            frames, TensorDictModule(nn.Sequential(last, nn.Tanh()), ["frames"], ["action"])
        ),
        "earlier frame": TensorDictSequential(
            frames, TensorDictModule(nn.Sequential(earlier, nn.Tanh()), ["frames"], ["action"])
        ),
        "lagged": TensorDictModule(
            Lagged(network), ["observation", "is_init", "before"], ["action", ("next", "before")]
        ),
    }


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize("string", slow_but(STRINGS[1:], STRINGS))
def test_a_policy_of_any_keys_drives_as_its_network_does(tmp_path, string) -> None:
    network, modules = networks()
    modules["drawn"].train()
    words = [*SMALL, f"scenario.string='{string}'"]
    found = lcc_rl.compare({"plain": network, **modules}, "alcc", words, tmp_path / "run")
    rows = {
        str(name): part.drop(columns=["strategy", "training_seed"]).to_numpy(object)[:, 5:]
        for name, part in found.rows.groupby("strategy")
    }
    rows = {name: torch.tensor(part.astype(float)).nan_to_num() for name, part in rows.items()}
    for name in ("root", "group", "drawn", "last frame"):
        torch.testing.assert_close(rows[name], rows["plain"], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(rows["earlier frame"], rows["lagged"], rtol=1e-4, atol=1e-4)
    assert (rows["lagged"] - rows["plain"]).abs().max() > 1e-2
    assert modules["drawn"].training
    assert list((tmp_path / "run" / "figures").glob("*.png"))


def normalized(kind: type, network: nn.Module, **settings) -> TensorDictSequential:
    """Return a policy behind a normaliser that has seen episodes of four environments."""
    keys = {"in_keys": ["observation"], "out_keys": ["observation"]}
    norm = kind(**keys, **settings)
    env = lcc_rl.make_env("alcc", 4, [*NO_AGENT], seed=1).append_transform(norm)
    env.rollout(30, break_when_any_done=False)
    return TensorDictSequential(norm, TensorDictModule(network, *ROOT))


@EXPERIMENTAL
@pytest.mark.parametrize(("kind", "settings"), [(VecNorm, {}), (VecNormV2, {"decay": 1.0})])
def test_comparing_leaves_the_statistics_of_a_normaliser(kind, settings) -> None:
    reduced = {"reduce_batch_dims": True} if kind is VecNormV2 else {}
    policy = normalized(kind, networks()[0], **settings, **reduced)
    still = TensorDictSequential(policy[0].to_observation_norm(), policy[1])
    before = {name: value.clone() for name, value in still[0].state_dict().items()}
    found = lcc_rl.compare({"a": policy, "b": policy, "c": still}, overrides=SMALL).rows
    energies = found.groupby("strategy")["total_path_energy_kj"].sum()
    assert energies.nunique() == 1
    after = policy[0].to_observation_norm().state_dict()
    assert all(torch.equal(after[name], value) for name, value in before.items())


def test_what_acts_of_a_distribution_is_the_deterministic_sample_of_torchrl() -> None:
    moment = lcc_rl.make_env("alcc", 3, [*NO_AGENT], single=False).reset()
    kinds = [(TanhNormal, 0.7616), (TruncatedNormal, 0.2772)]  # of location 1, scale 1, ±1
    for kind, wanted in kinds:
        spread = TensorDictModule(
            lambda seen: (seen[:, :1] * 0.0 + 1.0,) * 2, ROOT[0], ["loc", "scale"]
        )
        keys = {"in_keys": ["loc", "scale"], "distribution_class": kind}
        given = as_given(ProbabilisticActor(spread, **keys), "x")
        action = given(moment)["automated", "action"]
        torch.testing.assert_close(action, torch.full_like(action, wanted), rtol=0, atol=1e-4)


def test_actions_beyond_their_range_are_named(caplog) -> None:
    network = networks()[0]
    loud = nn.Sequential(network, nn.Linear(1, 1, bias=False)).requires_grad_(False)
    loud[1].weight.fill_(3.0)  # an acceleration instead of a share
    for _ in range(2):  # the second time nothing is repeated
        lcc_rl.compare({"loud": loud, "right": network}, overrides=SMALL)
    (line,) = [one for one in caplog.messages if "beyond" in one]
    assert line.startswith("loud: ")
    assert "share of the largest acceleration" in line


CALLS = count()
MIXING = [
    lambda net, seen: net(seen - seen.mean(0)),
    lambda net, seen: net(seen) * (0.5 if (seen > 2.0).any() else 1.0),
    lambda net, seen: net(nn.functional.dropout(seen)),
    lambda net, seen: net(seen) + 0.001 * next(CALLS),
]


def test_a_policy_acts_by_the_observations_of_a_row_alone() -> None:
    moment = lcc_rl.make_env("alcc", 1, [*NO_AGENT], seed=0, single=False).reset()
    words = r"x gives an episode other .*second action alone, or in the same .* \('next', key\)"
    cases = [(TensorDictModule(partial(act, networks()[0]), *ROOT), words) for act in MIXING]
    check_refused(lambda policy: as_given(policy, "x").tried(moment), cases, ConfigError)
    normed = nn.Sequential(nn.BatchNorm1d(WIDTH), nn.Dropout(), networks()[0])
    for right in (normed, *networks()[1].values()):
        (given := as_given(right, "x")).tried(moment)
        assert not given.clipped()


def test_actions_and_weights_may_have_another_type() -> None:
    network, half = networks()[0], networks()[0].bfloat16()
    rounded = TensorDictModule(lambda seen: seen.bfloat16(), ["observation"], ["seen"])
    policies = {
        "a": network,
        "b": TensorDictModule(lambda seen: network(seen).double(), *ROOT),
        "c": TensorDictSequential(rounded, TensorDictModule(half, ["seen"], ["action"])),
    }
    found = lcc_rl.compare(policies, overrides=SMALL).rows
    plain, same, near = (x for _, x in found.groupby("strategy")["total_path_energy_kj"])
    np.testing.assert_array_equal(plain, same)
    np.testing.assert_allclose(plain, near, rtol=0.05)


def test_a_recurrent_policy_of_torchrl_drives() -> None:
    keys = {"in_keys": ["observation", "rs"], "out_keys": ["seen", ("next", "rs")]}
    policy = TensorDictSequential(
        GRUModule(input_size=WIDTH, hidden_size=4, **keys),
        TensorDictModule(nn.Linear(4, 1), ["seen"], ["action"]),
    )
    found = lcc_rl.compare([policy], overrides=SMALL)
    assert set(found.rows["strategy"]) == {"TensorDictSequential"}


@EXPERIMENTAL
def test_what_is_no_policy_of_these_keys_is_refused_in_a_line() -> None:
    network = networks()[0]
    apart = normalized(VecNormV2, network)
    unplayed = VecNorm(in_keys=["observation"], out_keys=["observation"])
    cases = [
        ({"x": apart}, "x: VecNormV2 has statistics of its own for each .*reduce_batch_dims=True"),
        ({"x": TensorDictSequential(unplayed, apart[1])}, "x: VecNorm has no statistics yet; pass"),
        ({"x": TensorDictSequential(apart[1], unplayed)}, "x: VecNorm must be the first module"),
        ({"x": nn.Linear(5, 1)}, "x fails for observations of 7 numbers: mat1 and mat2"),
        ({"x": nn.Linear(WIDTH, 2)}, r"x fails .* shape '\[1, 1, 1\]' is invalid"),
        ({"x": TensorDictModule(network, ["obs"], ["action"])}, r"x reads \['obs'\] and writes"),
        ({"x": TensorDictModule(network, ["observation"], ["act"])}, r"writes \['act'\]: expected"),
        ({"alcc": network}, "a policy alcc, which stands for 'network': choose another"),
    ]
    cases += [([network, networks()[0]], "two policies of one class; name them")]
    check_refused(lambda who: lcc_rl.compare(who, overrides=SMALL), cases, ConfigError)
    with pytest.raises(ConfigError, match="x is a policy, and variant idm has no agent"):
        lcc_rl.compare({"x": network}, "idm", [*NO_AGENT])
