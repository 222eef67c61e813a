"""Rollouts: the agent-environment loop, collection, evaluation, statistics and recordings."""
