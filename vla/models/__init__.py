"""Action tokenizers, image tokenizers, text encoders, policies' networks and the learner."""
