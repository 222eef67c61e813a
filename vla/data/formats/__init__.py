"""Formats of other programs: LeRobot datasets, plain files, video."""
