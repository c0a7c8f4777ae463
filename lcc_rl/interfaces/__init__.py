"""Interfaces to other software: Gymnasium environments, exported policies, SUMO."""
