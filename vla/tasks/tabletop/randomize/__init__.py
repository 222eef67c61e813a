"""Domain randomisation: one class per axis, each with its own random stream."""
