"""Similarity scores, trees over the views, accumulation along a tree."""
