"""Goals of the tabletop, one per file."""
