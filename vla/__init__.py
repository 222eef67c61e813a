"""Declarative experiments for Vision-Language-Action policies: one composed config is the experiment."""

__version__ = "0.1.0"
