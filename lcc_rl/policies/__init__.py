"""Policy room: whatever chooses the action, learned or not."""

from lcc_rl.policies.actor import GaussianExploration, make_actor
from lcc_rl.policies.idm import IDMPolicy, NoPolicy

__all__ = ["GaussianExploration", "IDMPolicy", "NoPolicy", "make_actor"]
