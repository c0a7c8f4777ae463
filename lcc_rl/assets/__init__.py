"""Asset room: small result tables that ship with the package, with their provenance."""
