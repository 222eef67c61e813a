"""A world of one point, and what learns and acts in it."""
