"""Piece room: everything that an environment is made of, one TensorDict transform each."""

from lcc_rl.pieces.barrier import Barrier
from lcc_rl.pieces.base import Feature, Piece, RewardPiece, Transition
from lcc_rl.pieces.estimator import DriverEstimator
from lcc_rl.pieces.features import MotorPower, Observation, TimeGap, TimeToCollision
from lcc_rl.pieces.knowledge import LeaderPreview, ObservationMemory
from lcc_rl.pieces.leader import NGSIMLeader, PlatoonLeader
from lcc_rl.pieces.platoon import PlatoonErrors, PlatoonMotion, PlatoonObservation
from lcc_rl.pieces.rewards import (
    CollisionPenalty,
    EfficiencyReward,
    EnergyReward,
    JerkReward,
    RewardTerm,
    SafetyReward,
    TotalReward,
    VelocityReward,
)
from lcc_rl.pieces.surrogates import SmoothEfficiency, Smoothness, SmoothSafety
from lcc_rl.pieces.termination import Collision
from lcc_rl.pieces.vehicles import CAVMotion, IDMFollower

__all__ = [
    "Barrier",
    "CAVMotion",
    "Collision",
    "CollisionPenalty",
    "DriverEstimator",
    "EfficiencyReward",
    "EnergyReward",
    "Feature",
    "IDMFollower",
    "JerkReward",
    "LeaderPreview",
    "MotorPower",
    "NGSIMLeader",
    "Observation",
    "ObservationMemory",
    "Piece",
    "PlatoonErrors",
    "PlatoonLeader",
    "PlatoonMotion",
    "PlatoonObservation",
    "RewardPiece",
    "RewardTerm",
    "SafetyReward",
    "SmoothEfficiency",
    "SmoothSafety",
    "Smoothness",
    "TimeGap",
    "TimeToCollision",
    "TotalReward",
    "Transition",
    "VelocityReward",
]
