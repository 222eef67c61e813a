"""The simulated Franka tabletop: scene, randomisation, goals, controller and scripted expert."""
