"""Training under lightning."""
