"""The Franka tabletop: scene, randomisation, goals and scripted expert."""
