"""Action tokenizers, image encoders, text encoders, policy networks and the learner."""
