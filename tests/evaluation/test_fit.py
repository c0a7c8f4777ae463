"""What a trained policy is checked for before it drives."""

from __future__ import annotations

import pytest
from helpers import compose

from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.fit import check_policy


def test_observed_entries_in_another_order_are_refused() -> None:
    own, cfg = compose("alcc"), compose("alcc")
    check_policy(cfg, own)
    scales = cfg.observation["scales"]
    cfg.observation["scales"] = dict(reversed(scales.items()))
    words = "another order of observation.scales: expected scales.ahead.speed, .* got scales.behind"
    with pytest.raises(ConfigError, match=words):
        check_policy(cfg, own)
