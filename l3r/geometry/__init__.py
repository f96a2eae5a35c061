"""Pure functions on tensors: transforms, cameras, fits."""
