"""Configurations: composed by Hydra and parsed once into a checked, typed tree."""

from lcc_rl.config.compose import load

__all__ = ["load"]
