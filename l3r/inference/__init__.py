"""Photos become a reconstruction."""
