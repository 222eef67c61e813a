"""Parallel work in processes of this machine."""
