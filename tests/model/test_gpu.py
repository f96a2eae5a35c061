"""On an accelerator: ``pytest -m gpu``."""

import pytest
import torch

from l3r.config import LossConfig
from l3r.loss.joint import JointLoss
from tests.loss.scenes import random_views
from tests.model.test_light3r import build


@pytest.mark.gpu
def test_a_training_step_gives_what_it_gives_on_the_host():
    if not torch.cuda.is_available():
        pytest.skip("torch finds no GPU")
    gradients = []
    for device in ("cpu", "cuda"):
        model = build().to(device)
        views = random_views(3).to(device)
        prediction = model(views.image.double(), views.true_shape, views.scores)
        terms = JointLoss(LossConfig())(prediction, views)
        terms.total.backward()
        gradients.append([p.grad.cpu() for p in model.parameters()])
    for host, accelerator in zip(*gradients, strict=True):
        torch.testing.assert_close(accelerator, host, rtol=1e-6, atol=1e-8)
