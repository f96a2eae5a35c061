"""Pose accuracy: pure maths, no files."""
