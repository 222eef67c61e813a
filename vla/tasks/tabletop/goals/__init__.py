"""Goals of the tabletop."""
