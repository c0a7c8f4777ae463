#!/usr/bin/env bash
# TorchRL `FrameSkipTransform(4)`, an action held for four steps: an episode that ends in a
# skipped step does not end (torchrl 0.14.1).
# Guess before: it stops there and `done` is True.
# Seen: a car that crashes in the second step drives on to a gap of -7 m, `done` is False; if the
# environment repeats `done`, one crash is punished three times (-299 instead of -99).
# Hurt: who lets a policy act at 1 Hz in a 10 Hz simulation.
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
from torchrl.envs.transforms import FrameSkipTransform


class Crash(EnvBase):
    """The gap falls by 1 m a step from 5 m; the crash comes in step 2, with reward -100."""

    def __init__(self, latched):
        super().__init__(batch_size=torch.Size([]))
        self.latched = latched
        self.observation_spec = Composite(gap=Unbounded((1,)))
        self.action_spec = Bounded(-3.0, 3.0, (1,))
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict=None):
        self.step_count = 0
        return TensorDict({"gap": torch.tensor([5.0])}, [])

    def _step(self, tensordict):
        self.step_count += 1
        crashed = self.step_count >= 2 if self.latched else self.step_count == 2
        done = torch.tensor([crashed])
        values = {"gap": torch.tensor([5.0 - self.step_count]), "done": done, "terminated": done}
        return TensorDict({**values, "reward": torch.tensor([-100.0 if crashed else 1.0])}, [])

    def _set_seed(self, seed):
        pass


def rollout(latched):
    found = TransformedEnv(Crash(latched), FrameSkipTransform(4)).rollout(3)["next"]
    return [found[name].flatten().tolist() for name in ("done", "reward", "gap")]


once, repeated = rollout(latched=False), rollout(latched=True)
print("done once:     done {}, reward {}, gap {} m".format(*once))
print("done repeated: done {}, reward {}, gap {} m".format(*repeated))
same = once == [[False] * 3, [-97.0, 4.0, 4.0], [1.0, -3.0, -7.0]]
sys.exit(0 if same and repeated == [[True], [-299.0], [1.0]] else 1)
EOF
