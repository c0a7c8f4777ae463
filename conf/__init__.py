"""Hydra's configuration files, importable as ``lcc_rl.conf``."""
