"""LIBERO and LIBERO-PRO: forty tasks of a Panda (arXiv 2306.03310), and their perturbed versions (arXiv 2510.03827)."""

from vla.tasks.gl import choose_backend

choose_backend()  # before the modules of this package import MuJoCo
