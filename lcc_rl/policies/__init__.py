"""Policy room: whatever chooses the action, learned or not."""

from lcc_rl.policies.actor import GaussianExploration, make_actor
from lcc_rl.policies.cacc import CACCPolicy
from lcc_rl.policies.constant import ConstantPolicy
from lcc_rl.policies.deadbeat import DeadBeatPolicy
from lcc_rl.policies.hcfs import HCFSPolicy
from lcc_rl.policies.idm import IDMPolicy

__all__ = [
    "CACCPolicy",
    "ConstantPolicy",
    "DeadBeatPolicy",
    "GaussianExploration",
    "HCFSPolicy",
    "IDMPolicy",
    "make_actor",
]
