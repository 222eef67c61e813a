"""File input and output: constrained types, bounded documents, atomic writes."""
