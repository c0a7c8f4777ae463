"""The study of Adaptive Leading Cruise Control (ALCC)."""
