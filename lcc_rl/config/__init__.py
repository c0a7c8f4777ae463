"""Configurations: composed by Hydra and parsed once into a checked, typed tree."""

from lcc_rl.config.compose import (
    HYDRA_ERRORS,
    NOT_IDENTITY,
    as_meant,
    check_own_files,
    choices,
    composed,
    config_hash,
    explained,
    identity,
    is_sweep,
    load,
    own_file,
    parsed,
    with_inputs,
)
from lcc_rl.config.words import check_overrides, key_of, quoted, top_key, with_variant

__all__ = [
    "HYDRA_ERRORS",
    "NOT_IDENTITY",
    "as_meant",
    "check_overrides",
    "check_own_files",
    "choices",
    "composed",
    "config_hash",
    "explained",
    "identity",
    "is_sweep",
    "key_of",
    "load",
    "own_file",
    "parsed",
    "quoted",
    "top_key",
    "with_inputs",
    "with_variant",
]
