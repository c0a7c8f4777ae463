"""The driver models by name."""

from __future__ import annotations

from lcc_rl.functional.gipps import GIPPS_LAW
from lcc_rl.functional.idm import IDM_LAW
from lcc_rl.functional.ovm import FVDM_LAW, OVM_LAW

LAWS = {"idm": IDM_LAW, "ovm": OVM_LAW, "fvdm": FVDM_LAW, "gipps": GIPPS_LAW}
