"""Configs: checked, adopted and built. Besides, only `run.py` and the callback of sweeps use hydra and omegaconf."""
