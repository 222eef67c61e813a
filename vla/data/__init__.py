"""The episode store, the window loader and exporters."""
