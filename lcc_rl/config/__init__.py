"""Configurations: composed by Hydra, parsed once into a typed tree whose nodes are checked."""

from lcc_rl.config.compose import (
    HYDRA_ERRORS,
    NOT_IDENTITY,
    as_meant,
    composed,
    config_hash,
    explained,
    identity,
    is_sweep,
    load,
    parsed,
)

__all__ = [
    "HYDRA_ERRORS",
    "NOT_IDENTITY",
    "as_meant",
    "composed",
    "config_hash",
    "explained",
    "identity",
    "is_sweep",
    "load",
    "parsed",
]
