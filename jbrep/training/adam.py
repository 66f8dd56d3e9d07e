"""The state of torch's Adam optimisers."""

import torch
from torch.optim import Optimizer


def allocate_adam_state(optimizer: Optimizer) -> None:
    """Create now the state that Adam would create in its first step, for a checkpoint to fill."""
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            optimizer.state[parameter] = {
                "step": torch.zeros((), device=parameter.device),
                "exp_avg": torch.zeros_like(parameter),
                "exp_avg_sq": torch.zeros_like(parameter),
            }
