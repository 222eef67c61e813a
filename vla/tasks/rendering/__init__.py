"""Pictures of any MuJoCo model: a fast renderer, and MuJoCo's own as the reference."""
