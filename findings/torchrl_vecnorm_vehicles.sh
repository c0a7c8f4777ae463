#!/usr/bin/env bash
# TorchRL `VecNorm` and `VecNormV2` on observations [batch, vehicles, features]: each place in the
# string gets a mean and a deviation of its own (torchrl 0.14.1).
# Guess before: one per feature, pooled over vehicles.
# Seen: of two cars with gaps of 20 and 60 m both inputs have mean 0: a network that all cars
# share cannot tell them apart, and one gap is another input in each place.
# Hurt: who trains a shared policy for several cars, or uses it for another number of cars.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        torchrl==0.14.1 tensordict==0.14.3 torch==2.13.0 numpy==2.4.1 || exit 2
cd "$folder"
venv/bin/python -W ignore - <<'EOF'
import sys

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import VecNorm, VecNormV2


class Cars(EnvBase):
    """Eight roads with two cars each; the gaps are about 20 m and 60 m."""

    def __init__(self):
        super().__init__(batch_size=torch.Size([8]))
        self.observation_spec = Composite(gap=Unbounded((8, 2, 1)), shape=(8,))
        self.action_spec = Bounded(-3.0, 3.0, (8, 2, 1))
        self.reward_spec = Unbounded((8, 1))

    def gaps(self):
        return torch.tensor([[20.0], [60.0]]) + torch.randn(8, 2, 1)

    def _reset(self, tensordict=None):
        return TensorDict({"gap": self.gaps()}, [8])

    def _step(self, tensordict):
        ends = torch.zeros(8, 1, dtype=torch.bool)
        values = {"gap": self.gaps(), "done": ends, "terminated": ends}
        return TensorDict({**values, "reward": torch.zeros(8, 1)}, [8])

    def _set_seed(self, seed):
        pass


same = True
for transform in (VecNorm(in_keys=["gap"], decay=1.0), VecNormV2(in_keys=["gap"], decay=1.0)):
    torch.manual_seed(0)
    rows = TransformedEnv(Cars(), transform).rollout(400)["next", "gap"][:, 200:]
    means = rows.mean((0, 1)).flatten()
    print(f"{type(transform).__name__}: mean input of the car 20 m and of the car 60 m behind its "
          f"leader: {means[0]:.2f}, {means[1]:.2f} (pooled: -1 and 1)")
    same &= bool(means.abs().max() < 0.2)
sys.exit(0 if same else 1)
EOF
