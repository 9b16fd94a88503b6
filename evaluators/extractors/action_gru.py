"""An action classifier, that of HumanAct12: a GRU over joint positions (Guo et al. 2020, "Action2Motion")."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from evaluators.extractors.released import load_strictly, read_weights

NUM_ACTIONS = 12


class ActionGRU(nn.Module):
    """Two GRU layers read the joints, the state at the last real frame is classified.

    The released weights give the features and the accuracy of every HumanAct12 table. The authors start the recurrence
    from a fresh normal draw at every call, so that their numbers are random even for fixed motions; here it starts from
    zero, unless a state is given (`random_state` draws one as they do).
    """

    features = 30

    def __init__(
        self,
        num_joints: int = 24,
        hidden: int = 128,
        num_layers: int = 2,
        *,
        num_actions: int = NUM_ACTIONS,
        recenter: bool = True,
    ):
        """Sizes are those of the released weights; `recenter` moves the pelvis of the first frame to the origin."""
        super().__init__()
        self.recenter = recenter
        self.recurrent = nn.GRU(3 * num_joints, hidden, num_layers, batch_first=True)
        self.linear1 = nn.Linear(hidden, self.features)
        self.linear2 = nn.Linear(self.features, num_actions)

    def forward(self, joints: Tensor, mask: Tensor, state: Tensor | None = None) -> Tensor:
        """Features of motions.

        Args:
            joints: (B, F, J, 3) metres, y up, SMPL's 24 joints for the released weights; the network sees them y down,
                as published.
            mask: (B, F) bool, True = real frame; every motion has one at least.
            state: (layers, B, hidden) where the recurrence starts; None = zeros.

        Returns:
            (B, 30) in (-1, 1).
        """
        joints = joints * joints.new_tensor([1.0, -1.0, -1.0])
        if self.recenter:
            joints = joints - joints[:, :1, :1]
        outputs, _ = self.recurrent(joints.flatten(2), state)
        last = mask.sum(1) - 1
        return torch.tanh(self.linear1(outputs[torch.arange(len(last), device=last.device), last]))

    def logits(self, joints: Tensor, mask: Tensor, state: Tensor | None = None) -> Tensor:
        """(B, actions) unnormalized log-probabilities of the actions; arguments as of `forward`."""
        return self.linear2(self(joints, mask, state))

    def random_state(self, batch: int, generator: torch.Generator) -> Tensor:
        """(layers, B, hidden) standard normal: the start of the authors' recurrence, drawn from a seed."""
        shape = (self.recurrent.num_layers, batch, self.recurrent.hidden_size)
        return torch.randn(shape, generator=generator).to(self.linear1.weight)


def load_action_gru(path: str | Path) -> ActionGRU:
    """The classifier with the authors' weights (action_recognition_model_humanact12.tar, in MDM humanact12_gru.tar).

    Raises:
        FileNotFoundError: no such file.
        ValueError: it holds other weights.
    """
    return load_strictly(ActionGRU(), read_weights(path, "model"), path)
