"""Meta-World: fifty tasks of a Sawyer arm (arXiv 1910.10897, 2505.11289), with a scripted expert each."""
