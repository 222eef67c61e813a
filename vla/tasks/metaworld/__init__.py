"""Meta-World: fifty tasks of a Sawyer arm (arXiv 1910.10897, 2505.11289), with a scripted expert each."""

from vla.tasks.gl import choose_backend

choose_backend()  # before the modules of this package import MuJoCo
