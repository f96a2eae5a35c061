"""How close is equal, by dtype; a looser bound in a test needs a comment there."""

import torch

TOLERANCE = {torch.float64: 1e-9, torch.float32: 1e-5, torch.bfloat16: 2e-2}
ANGLE_DEG = 1e-3
