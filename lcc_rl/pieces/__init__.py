"""Piece room: everything that an environment is made of, one TensorDict transform each."""

from lcc_rl.pieces.base import Feature, Piece, RewardPiece, Transition
from lcc_rl.pieces.estimator import DriverEstimator
from lcc_rl.pieces.features import MotorPower, Observation, TimeGap, TimeToCollision
from lcc_rl.pieces.leader import NGSIMLeader
from lcc_rl.pieces.rewards import (
    CollisionPenalty,
    EfficiencyReward,
    EnergyReward,
    RewardTerm,
    SafetyReward,
    TotalReward,
)
from lcc_rl.pieces.surrogates import SmoothEfficiency, SmoothSafety
from lcc_rl.pieces.termination import Collision
from lcc_rl.pieces.vehicles import CAVMotion, IDMFollower

__all__ = [
    "CAVMotion",
    "Collision",
    "CollisionPenalty",
    "DriverEstimator",
    "EfficiencyReward",
    "EnergyReward",
    "Feature",
    "IDMFollower",
    "MotorPower",
    "NGSIMLeader",
    "Observation",
    "Piece",
    "RewardPiece",
    "RewardTerm",
    "SafetyReward",
    "SmoothEfficiency",
    "SmoothSafety",
    "TimeGap",
    "TimeToCollision",
    "TotalReward",
    "Transition",
]
