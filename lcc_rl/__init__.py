"""lcc_rl: learn and compare car-following controllers in mixed traffic."""

__version__ = "0.1.0"
