"""Deployment of a trained policy on a robot."""
