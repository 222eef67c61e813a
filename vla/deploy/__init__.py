"""Putting a trained policy on a robot."""
