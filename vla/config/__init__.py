"""Configs: checked, adopted from checkpoints, and built; with `run.py` the only importers of hydra and omegaconf."""
