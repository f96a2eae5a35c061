"""What measures speed and memory; each module has ``run() -> list[(name, value)]``."""
