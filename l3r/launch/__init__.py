"""Many runs: sweeps over settings and seeds, here or as SLURM arrays, and their tables."""
