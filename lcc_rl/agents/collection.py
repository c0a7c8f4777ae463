"""Collection: the collector of a training, which keeps no more than is learned from."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.collectors import Collector
from torchrl.envs import Transform, TransformedEnv

TRUNCATED = ("next", "truncated")  # the collector marks the end of its batch here


class Keep(Transform):
    """Drops, of every step just taken, the entries that nobody will read, before they are stacked.

    The state from which the environment goes on stays whole.

    Args:
        keys: the entries to keep, those of the moment reached under ``"next"``.
    """

    def __init__(self, keys: Sequence[NestedKey]) -> None:
        super().__init__()
        self.keys = tuple(keys)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset

    def _post_step_mdp_hooks(
        self, tensordict: TensorDictBase, tensordict_: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        return tensordict.select(*self.keys, inplace=True), tensordict_


def make_collector(
    env: TransformedEnv,
    policy: TensorDictModuleBase,
    steps: int,
    keys: Sequence[NestedKey],
    compiled: bool = False,
) -> Collector:
    """Build the collector of a training.

    Args:
        env: the environment; :class:`Keep` is appended to it.
        policy: acts in it.
        steps: steps of every environment in one batch.
        keys: the entries that a batch holds.
        compiled: compile the step of the environment.

    Returns:
        A collector whose batches are ``[*env.batch_size, steps]``.
    """
    env.append_transform(Keep((*keys, TRUNCATED)))
    if compiled:
        env.compile(dynamic=False)
    return Collector(
        env,
        policy,
        frames_per_batch=env.batch_size.numel() * steps,
        total_frames=-1,
        auto_register_policy_transforms=False,
        track_traj_ids=False,
    )
