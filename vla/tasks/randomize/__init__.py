"""Domain randomisation: one class per axis, each with its own switch and its own random stream."""
