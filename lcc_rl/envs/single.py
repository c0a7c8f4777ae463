"""Views of the automated vehicles for stock TorchRL scripts: of one vehicle, and of several."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDict, TensorDictBase
from torch import Size
from torchrl.data import Composite
from torchrl.envs.transforms import Transform

from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.pieces.base import Entry, Key

# Entries of the group that the view shows at the root, without the dimension of vehicles.
GROUP_ENTRIES = ("observation", "reward", "reward_terms")
ENDS = ("done", "terminated", "truncated")  # of the string, which the group shows, too


class SingleAgent(Transform):
    """Shows the entries of the one automated vehicle at the root, without its dimension.

    ``("automated", "observation")``, ``[*batch, 1, n]``, becomes ``"observation"``, ``[*batch,
    n]``; likewise ``"action"``, ``"reward"`` and ``("reward_terms", name)``. It must be the last
    transform of an environment.
    """

    shows = (
        Entry("observation", "–", "observation in the single-agent view"),
        Entry("action", "–", "action in the single-agent view"),
        Entry("reward_terms.name", "–", "terms of the reward in the single-agent view"),
        Entry("reward", "–", "reward in the single-agent view"),
    )

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        group = next_tensordict.get(AUTOMATED, None)
        if group is None:
            return next_tensordict
        group = group.copy()
        for name in GROUP_ENTRIES:
            entry = group.pop(name, None)
            if entry is not None:
                next_tensordict.set(name, _without(entry))
        return next_tensordict.set(AUTOMATED, group)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action", None)
        if action is not None:
            tensordict.set((AUTOMATED, "action"), action.unsqueeze(-2))
        return tensordict

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        return self._shown(input_spec.clone(), "full_action_spec", ("action",))

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        observed = ("observation", "reward_terms")
        output_spec = self._shown(output_spec.clone(), "full_observation_spec", observed)
        return self._shown(output_spec, "full_reward_spec", ("reward",))

    def _shown(self, specs: Composite, space: str, names: tuple[str, ...]) -> Composite:
        spec = specs[space]
        if AUTOMATED not in spec.keys():  # noqa: SIM118  a rule has no action
            return specs
        group = spec[AUTOMATED]
        for name in names:
            if name in group.keys():  # noqa: SIM118  a spec is no dict
                spec[name] = (
                    group[name].squeeze(-2) if name != "reward_terms" else _flat(group[name])
                )
                del group[name]
        if not len(list(group.keys())):
            del spec[AUTOMATED]
        specs[space] = spec
        return specs


class MultiAgent(Transform):
    """Shows the automated vehicles as a group of agents, as TorchRL's PettingZooWrapper does.

    The TensorDict and the specs of the group have the dimension of vehicles, ``[*batch, n]``, and
    hold ``"done"``, ``"terminated"`` and ``"truncated"`` of the string for each vehicle, so that
    losses find them at the shape of the reward. It must be the last transform of an environment.
    """

    keys = tuple((AUTOMATED, name) for name in ENDS)
    shows = tuple(Entry(key, "–", f"{key[1]} of the string, for each vehicle") for key in keys)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        group = next_tensordict.get(AUTOMATED, None)
        if group is None:
            return next_tensordict
        size, entries = _agents(group), dict(group.items())
        for name, end in next_tensordict.select(*ENDS, strict=False).items():
            entries[name] = end.unsqueeze(-2).expand(*size, 1)
        return next_tensordict.set(AUTOMATED, TensorDict(entries, size, device=group.device))

    forward, _reset = _call, SingleAgent._reset

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        return self._grouped(input_spec.clone())

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        specs = output_spec.clone()
        size, done = _agents(specs["full_observation_spec", AUTOMATED]), specs["full_done_spec"]
        for name in ENDS:
            done[AUTOMATED, name] = done[name].unsqueeze(-2).expand(*size, 1).clone()
        return self._grouped(specs)

    def _grouped(self, specs: Composite) -> Composite:
        for spec in specs.values():
            if AUTOMATED in spec.keys():  # noqa: SIM118  a spec is no dict
                spec[AUTOMATED].shape = _agents(spec[AUTOMATED])
        return specs


def view_of(vehicles: int) -> SingleAgent | MultiAgent:
    """Return the view of a number of automated vehicles."""
    return SingleAgent() if vehicles == 1 else MultiAgent()


VIEWS = SingleAgent | MultiAgent


def _agents(group: TensorDictBase | Composite) -> Size:
    """Return the size of a group with the dimension of vehicles."""
    return next(iter(group.values(True, True))).shape[: len(group.shape) + 1]


def _without(entry: TensorDictBase) -> TensorDictBase:
    """Return a tensor, or every tensor of a TensorDict, without the dimension of vehicles."""
    if isinstance(entry, TensorDictBase):
        return entry.apply(lambda x: x.squeeze(-2), batch_size=entry.batch_size)
    return entry.squeeze(-2)


def _flat(terms: Composite) -> Composite:
    flat = {name: spec.squeeze(-2) for name, spec in terms.items()}
    return Composite(flat, shape=terms.shape, device=terms.device)


def group_key(key: Key) -> Key:
    """Return the key in the group for a key at the root."""
    return (AUTOMATED, *key) if key[0] in (*GROUP_ENTRIES, "action") else key


def find(td: TensorDictBase, key: Key) -> Any:
    """Return an entry of the pieces, which a view may show at the root; None if there is none."""
    value = td.get(key, None)
    return td.get(key[1:], None) if value is None and key[0] == AUTOMATED else value
