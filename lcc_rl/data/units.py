"""Conversion constants from the units of published files to SI."""

from __future__ import annotations

FOOT = 0.3048  # m
FRAME = 0.1  # s; every published NGSIM file has 10 frames a second
