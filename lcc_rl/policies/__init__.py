"""Policies: networks, exploration, and controllers as policies."""

from lcc_rl.policies.actor import GaussianExploration, make_actor, shared_policy
from lcc_rl.policies.controller import ControllerPolicy

__all__ = ["ControllerPolicy", "GaussianExploration", "make_actor", "shared_policy"]
