"""Config validation, merging and construction; elsewhere only `run.py` and `jobs/sweep.py` use Hydra or OmegaConf."""
