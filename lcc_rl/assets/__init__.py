"""Shipped drive cycles, driver tables and policies."""
