"""Policy room: whatever chooses the action, learned or not."""

from lcc_rl.policies.actor import GaussianExploration, make_actor
from lcc_rl.policies.cacc import CACCPolicy
from lcc_rl.policies.deadbeat import DeadBeatPolicy
from lcc_rl.policies.hcfs import HCFSPolicy
from lcc_rl.policies.idm import IDMPolicy, NoPolicy

__all__ = [
    "CACCPolicy",
    "DeadBeatPolicy",
    "GaussianExploration",
    "HCFSPolicy",
    "IDMPolicy",
    "NoPolicy",
    "make_actor",
]
