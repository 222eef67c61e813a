"""Pictures of any MuJoCo model: a fast renderer, and MuJoCo's own as the reference."""

from vla.tasks.gl import choose_backend

choose_backend()  # before the modules of this package import MuJoCo
