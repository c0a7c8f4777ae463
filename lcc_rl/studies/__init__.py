"""Studies: sets of runs with tables, figures and a page."""
