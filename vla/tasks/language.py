"""Instructions: templates with slots, drawn per episode."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def instruction(templates: Sequence[str], random_state: np.random.RandomState, **slots: str) -> str:
    """One of `templates`, drawn evenly, with its slots filled: "lift the {block} block" → "lift the red block"."""
    return templates[random_state.randint(len(templates))].format(**slots)
