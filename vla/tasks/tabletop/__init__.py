"""The Franka tabletop: scene, randomisation, goals and scripted expert."""

from vla.tasks.gl import choose_backend

choose_backend()  # before the modules of this package import MuJoCo
