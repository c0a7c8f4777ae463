"""Figures and pages, drawn from tables of results."""
