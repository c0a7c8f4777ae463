"""Figures and pages from tables of results."""
