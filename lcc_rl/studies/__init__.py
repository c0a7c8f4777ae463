"""Studies: many runs of the entry points, with their tables, figures and page."""
