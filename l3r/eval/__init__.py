"""Benchmarks: predict, then score."""
