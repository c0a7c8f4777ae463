"""The study of the Hybrid Car-Following Strategy (HCFS)."""
