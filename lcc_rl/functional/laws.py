"""Driver models by name."""

from __future__ import annotations

from lcc_rl.functional.driver_models import DriverConstants
from lcc_rl.functional.gipps import GippsConstants
from lcc_rl.functional.idm import IDMConstants
from lcc_rl.functional.ovm import FVDMConstants, OVMConstants

LAWS: dict[str, type[DriverConstants]] = {
    "idm": IDMConstants,
    "ovm": OVMConstants,
    "fvdm": FVDMConstants,
    "gipps": GippsConstants,
}
