"""Pieces: everything that an environment is made of, one TensorDict transform each."""

# ruff: noqa: F401  imported from here by other packages and users

from lcc_rl.functional.pattern import VehicleString, parse_string
from lcc_rl.pieces.actuation import Actuation
from lcc_rl.pieces.base import Entry, Feature, Piece, RewardPiece, StepTransform
from lcc_rl.pieces.cbf import CBFFilter, Corrected
from lcc_rl.pieces.connected import CACC, Communication, DeadBeat
from lcc_rl.pieces.controllers import Action, ConstantAcceleration, Controller, Law
from lcc_rl.pieces.cruise import IDMACC, LinearACC
from lcc_rl.pieces.drivers import FVDM, IDM, OVM, CalibratedDrivers, DriverModel, Gipps
from lcc_rl.pieces.estimator import DriverEstimator
from lcc_rl.pieces.features import EnergyClasses, MotorPower, TimeGap, TimeToCollision
from lcc_rl.pieces.hybrid import HCFS, Hybrid
from lcc_rl.pieces.knowledge import LeaderPreview, ObservationMemory, TrafficAhead
from lcc_rl.pieces.leader import NGSIMLeader
from lcc_rl.pieces.mpc import MPC
from lcc_rl.pieces.observation import Observation
from lcc_rl.pieces.ranges import RangeReward, SmoothRange
from lcc_rl.pieces.recorded import RecordedDriver
from lcc_rl.pieces.replaced import ReplacedLeader
from lcc_rl.pieces.rewards import (
    CollisionPenalty,
    EfficiencyReward,
    EnergyReward,
    JerkReward,
    RewardTerm,
    SafetyReward,
    SpacingReward,
    TotalReward,
    VelocityReward,
)
from lcc_rl.pieces.rules import Calm, FollowerStopper, Handover, PISaturation
from lcc_rl.pieces.sensors import Sensors
from lcc_rl.pieces.slope import Slope, SlopePreview
from lcc_rl.pieces.start import EquilibriumStart, HeadwayStart, TimeGapStart
from lcc_rl.pieces.string import RolePlaces, StringMotion
from lcc_rl.pieces.surrogates import (
    Correction,
    ExcessSpacing,
    PathEnergy,
    SmoothEfficiency,
    Smoothness,
    SmoothSafety,
    SpeedSpread,
)
from lcc_rl.pieces.termination import Collision
