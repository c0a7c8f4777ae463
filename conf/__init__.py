"""Configuration room: Hydra's yaml files, importable as ``lcc_rl.conf``."""
