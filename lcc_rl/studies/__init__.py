"""Study room: many runs of the entry points, and what they say together."""
