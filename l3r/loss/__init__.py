"""Confidence, pairwise, global and joint loss."""
