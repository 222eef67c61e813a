"""Run folders on disk: what they hold, and which run to resume."""
